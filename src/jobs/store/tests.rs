//! The suite on every store, and what only some of them do.

use std::sync::Arc;

use object_store::memory::InMemory;
use object_store::path::Path as Key;

use super::conformance::suite;
use super::folder::Folder;
use super::objects::Objects;
use super::*;
use crate::jobs::files::Files;
use crate::jobs::testing;

#[tokio::test]
async fn folders_conform() {
    let (data, apart) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    suite(&Folder::of_data(&Files::open(data.path()).unwrap()).unwrap()).await;
    suite(&Folder::at(apart.path(), Some(0)).unwrap()).await;
}

#[tokio::test]
async fn object_stores_conform() {
    let memory = Arc::new(InMemory::new());
    let at = |prefix: &str| Objects::new(memory.clone(), Key::from(prefix), "memory".into());
    at("").probe().await.unwrap();
    suite(&at("")).await;
    suite(&at("a/b")).await;
}

#[tokio::test]
async fn addresses_that_are_none_are_told_so() {
    let data = tempfile::tempdir().unwrap();
    let files = Files::open(data.path()).unwrap();
    for address in ["s3://", "s3:///prefix", "ftp://bucket", "s3://user@bucket/", "s3://bucket/a?b", "s3://bucket/a//b"]
    {
        let failure = open(Some(address), &files, None).await.map(|_| ()).unwrap_err();
        assert_eq!(failure.code, Code::InvalidRequest, "{address}: {failure}");
    }
    assert!(open(data.path().to_str(), &files, None).await.unwrap().is_local());
}

#[tokio::test]
async fn s3_servers_conform() {
    for server in [testing::moto(), testing::seaweedfs()].into_iter().flatten() {
        let at = |prefix: &str| {
            let key = if prefix.is_empty() { Key::default() } else { Key::from(prefix) };
            Objects::new(server.store(), key, format!("s3://{}", testing::BUCKET))
        };
        at("").probe().await.unwrap();
        suite(&at("")).await;
        suite(&at("some/prefix")).await;
    }
}
