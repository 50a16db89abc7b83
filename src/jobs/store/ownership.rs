//! Whose a store is: it carries the identity of its queue, so that no other queue collects what it does not know.

use super::Store;
use crate::error::{Code, Failure, Result};

/// The identity of the queue that the store belongs to.
const IDENTITY: &str = "identity";
/// The identity of a queue that was made when there were files already.
const STRANGER: &str = "identity.new";

/// Makes sure that the stored files belong to the queue of this identity, which was made just now or not. A store and its queue carry one
/// identity. False where files are here whose queue is gone: the new one must not collect what it does not know.
///
/// # Errors
/// `unavailable`: the queue is another store's, or the store fails.
pub async fn own(store: &dyn Store, identity: &str, fresh: bool, adopt: bool) -> Result<bool> {
    let mine = store.marker(IDENTITY).await?;
    let stored = !store.is_empty().await?;
    let strange = store.marker(STRANGER).await?.as_deref() == Some(identity);
    let known = match mine.as_deref() {
        Some(mine) => mine == identity || (fresh && !stored),
        // A store of before there were identities, or an empty one.
        None => !strange && (!fresh || !stored),
    };
    let name = store.name();
    if known || adopt {
        // Of two queues that take an empty store at the same time, one is refused.
        if mine.as_deref() != Some(identity)
            && !store.set_marker(IDENTITY, identity, mine.is_some()).await?
            && store.marker(IDENTITY).await?.as_deref() != Some(identity)
        {
            return Err(foreign(&name));
        }
        store.remove_marker(STRANGER).await?;
        return Ok(true);
    }
    if !fresh && !strange {
        return Err(foreign(&name));
    }
    store.set_marker(STRANGER, identity, true).await?;
    tracing::error!(
        "{name} holds files of jobs, and the queue that knew them is gone: a new queue was made, and nothing will be removed. Stop the \
         service and put the old queue (queue.sqlite, or the database) back from a backup, or give the files up with --adopt-store"
    );
    Ok(false)
}

fn foreign(name: &str) -> Failure {
    let message = format!(
        "the job queue belongs to another data folder than {name}, and nothing was changed: put its own queue (queue.sqlite, or the database \
         of --queue) back, or give up the files that are stored there with --adopt-store"
    );
    Failure::new(Code::Unavailable, message)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use axum::body::Bytes;

    use super::*;
    use crate::jobs::store::folder::Folder;

    async fn folder(object: bool) -> (tempfile::TempDir, Folder) {
        let root = tempfile::tempdir().unwrap();
        let store = Folder::at(root.path(), None).unwrap();
        if object {
            store.put("abcd", Bytes::from_static(b"x")).await.unwrap();
        }
        (root, store)
    }

    #[tokio::test]
    async fn a_store_belongs_to_its_first_queue() {
        let (root, store) = folder(false).await;
        assert_eq!(own(&store, "a", true, false).await, Ok(true));
        assert_eq!(fs::read_to_string(root.path().join("identity")).unwrap(), "a\n");
        assert_eq!(own(&store, "a", false, false).await, Ok(true));
        // Another's queue is refused, whether files are here or not.
        assert_eq!(own(&store, "b", false, false).await.unwrap_err().code, Code::Unavailable);
        assert_eq!(own(&store, "a", false, false).await, Ok(true));
    }

    #[tokio::test]
    async fn files_without_their_queue_stay_until_their_owner_says_otherwise() {
        let (_root, store) = folder(true).await;
        assert_eq!(own(&store, "a", false, false).await, Ok(true), "a store of before there were identities");
        // The queue is lost; the new one is foreign at each start, but it may be used.
        assert_eq!(own(&store, "b", true, false).await, Ok(false));
        assert_eq!(own(&store, "b", false, false).await, Ok(false));
        // The old one comes back.
        assert_eq!(own(&store, "a", false, false).await, Ok(true));
        assert_eq!(own(&store, "c", true, false).await, Ok(false));
        assert_eq!(own(&store, "c", false, true).await, Ok(true));
        assert_eq!(own(&store, "a", false, false).await.unwrap_err().code, Code::Unavailable);
    }

    #[tokio::test]
    async fn files_of_before_there_were_identities_are_kept_as_well() {
        let (_root, store) = folder(true).await;
        assert_eq!(own(&store, "a", true, false).await, Ok(false));
        assert_eq!(own(&store, "a", false, false).await, Ok(false), "at each start");
        // The one that knew them comes back.
        assert_eq!(own(&store, "b", false, false).await, Ok(true));
        assert_eq!(own(&store, "a", true, false).await, Ok(false));
        assert_eq!(own(&store, "a", false, true).await, Ok(true));
    }
}
