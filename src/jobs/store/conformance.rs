//! What every store must do.

use std::collections::BTreeSet;
use std::fs;

use super::*;
use crate::jobs::files::UploadedFile;

/// Runs all checks on one empty store.
pub(super) async fn suite(store: &dyn Store) {
    objects_are_whole_or_not_there(store).await;
    many_may_store_one_object_at_the_same_time(store).await;
    large_objects_come_back_in_any_part(store).await;
    what_is_damaged_is_never_given_as_a_whole(store).await;
    uploads_come_back_as_they_were(store).await;
    markers_are_set_by_one(store).await;
    crate::jobs::resumable::pieces::conformance::suite(&*store.pieces()).await;
}

fn hash(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// Bytes that no two parts have alike.
fn noise(length: usize) -> Bytes {
    let mut state = 1u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    (0..length).map(|_| next()).collect()
}

async fn read(store: &dyn Store, place: &str, range: Range<u64>) -> Result<Vec<u8>> {
    let mut parts = store.get(place, range).await?;
    let mut all = Vec::new();
    while let Some(part) = parts.next().await.transpose()? {
        all.extend_from_slice(&part);
    }
    Ok(all)
}

async fn objects_are_whole_or_not_there(store: &dyn Store) {
    let none = read(store, &hash(b"none"), 0..1).await;
    assert_eq!(none.unwrap_err().code, Code::Gone);
    assert!(store.is_empty().await.unwrap());
    let place = format!("{}.1", hash(b"some bytes"));
    for _ in 0..2 {
        store.put(&place, Bytes::from_static(b"some bytes")).await.unwrap();
    }
    store.put(&hash(b""), Bytes::new()).await.unwrap();
    let places: BTreeSet<String> = store.places().await.unwrap().into_iter().collect();
    assert_eq!(places, BTreeSet::from([place.clone(), hash(b"")]));
    assert!(!store.is_empty().await.unwrap());
    assert_eq!(read(store, &place, 0..10).await.unwrap(), b"some bytes");
    assert_eq!(read(store, &place, 5..9).await.unwrap(), b"byte");
    assert_eq!(read(store, &hash(b""), 0..0).await.unwrap(), b"");
    for _ in 0..2 {
        store.remove(&place).await.unwrap();
        store.remove(&hash(b"")).await.unwrap();
    }
    assert_eq!(read(store, &place, 0..10).await.unwrap_err().code, Code::Gone);
    assert!(store.is_empty().await.unwrap());
    store.check(true).await.unwrap();
}

async fn many_may_store_one_object_at_the_same_time(store: &dyn Store) {
    for length in [1000, 20 << 20] {
        let bytes = noise(length);
        let place = hash(&bytes);
        let puts = (0..4).map(|_| store.put(&place, bytes.clone()));
        for put in futures_util::future::join_all(puts).await {
            put.unwrap();
        }
        assert!(read(store, &place, 0..length as u64).await.unwrap() == bytes);
        assert_eq!(store.places().await.unwrap(), [place.as_str()]);
        store.remove(&place).await.unwrap();
    }
    store.remove_unfinished(Duration::ZERO).await.unwrap();
}

async fn large_objects_come_back_in_any_part(store: &dyn Store) {
    // More than one request carries, and no multiple of anything.
    let bytes = noise((33 << 20) + 7);
    let place = hash(&bytes);
    store.put(&place, bytes.clone()).await.unwrap();
    let length = bytes.len() as u64;
    for range in [0..length, 0..1, length - 1..length, (4 << 20) - 1..(4 << 20) + 1, (8 << 20)..length] {
        let wanted = &bytes[range.start as usize..range.end as usize];
        assert!(read(store, &place, range.clone()).await.unwrap() == wanted, "{range:?}");
    }
    let whole = verified(store.get(&place, 0..length).await.unwrap(), place.clone());
    let parts: Vec<Bytes> = whole.map(|part| part.unwrap()).collect().await;
    assert!(parts.concat() == bytes);
    store.remove(&place).await.unwrap();
}

async fn what_is_damaged_is_never_given_as_a_whole(store: &dyn Store) {
    let bytes = noise(5 << 20);
    let place = hash(b"what it should be");
    store.put(&place, bytes.clone()).await.unwrap();
    let mut parts = verified(store.get(&place, 0..bytes.len() as u64).await.unwrap(), place.clone());
    let (mut given, mut failure) = (0, None);
    while let Some(part) = parts.next().await {
        match part {
            Ok(part) => given += part.len(),
            Err(found) => failure = Some(found),
        }
    }
    assert!(given < bytes.len() && failure.is_some_and(|f| f.code == Code::Internal));
    store.remove(&place).await.unwrap();
}

async fn uploads_come_back_as_they_were(store: &dyn Store) {
    let root = tempfile::tempdir().unwrap();
    let large = noise((17 << 20) + 3);
    let contents: [&[u8]; 3] = [b"model", b"", &large];
    let upload = |job: &str| {
        let folder = root.path().join(job);
        fs::create_dir_all(&folder).unwrap();
        for (n, bytes) in contents.iter().enumerate() {
            fs::write(folder.join(n.to_string()), bytes).unwrap();
        }
        folder
    };
    let file = |number: usize| UploadedFile { path: format!("../{number}"), number, sha256: hash(contents[number]) };
    let inputs = Manifest { models: vec![file(0)], files: vec![file(1), file(2)] };
    let brought = root.path().join("brought");
    assert_eq!(store.fetch("none", &inputs, &brought).await.unwrap_err().code, Code::Internal);
    assert!(!brought.exists());
    for job in ["one", "two"] {
        let received = upload(job);
        store.accept(job, &received, &inputs).await.unwrap();
        assert!(!received.exists(), "it is the store's now");
    }
    let fetched = store.fetch("one", &inputs, &brought).await.unwrap();
    for (n, bytes) in contents.iter().enumerate() {
        assert!(fs::read(fetched.folder().join(n.to_string())).unwrap() == *bytes, "{n}");
    }
    drop(fetched);
    assert!(!brought.exists(), "nothing is left of what was brought");
    assert_eq!(store.untouched_uploads(Duration::from_secs(3600)).await.unwrap(), Vec::<String>::new());
    tokio::time::sleep(Duration::from_millis(1100)).await;
    assert_eq!(store.untouched_uploads(Duration::ZERO).await.unwrap(), ["one", "two"]);
    for _ in 0..2 {
        store.remove_upload("one").await.unwrap();
    }
    assert!(store.fetch("one", &inputs, &brought).await.is_err());
    assert_eq!(store.untouched_uploads(Duration::ZERO).await.unwrap(), ["two"]);
    store.remove_upload("two").await.unwrap();
    assert!(store.is_empty().await.unwrap());
}

async fn markers_are_set_by_one(store: &dyn Store) {
    assert_eq!(store.marker("m").await, Ok(None));
    assert_eq!(store.set_marker("m", "a", false).await, Ok(true));
    assert_eq!(store.set_marker("m", "b", false).await, Ok(false));
    assert_eq!(store.marker("m").await, Ok(Some("a".into())));
    assert_eq!(store.set_marker("m", "c", true).await, Ok(true));
    assert_eq!(store.marker("m").await, Ok(Some("c".into())));
    for _ in 0..2 {
        store.remove_marker("m").await.unwrap();
    }
    assert_eq!(store.marker("m").await, Ok(None));
}
