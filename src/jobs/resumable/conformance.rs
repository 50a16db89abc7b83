//! What every store of uploads must do.

use super::*;

const BOUNDS: UploadBounds = UploadBounds { all: 4, of_tenant: 2, incomplete: None };

fn upload(id: &str, tenant: &str, length: u64) -> Upload {
    Upload {
        id: id.into(),
        reference: format!("{PREFIX}{id}"),
        filename: Some("chair.glb".into()),
        length,
        offset: 0,
        sha256: None,
        complete: false,
        created_at: Timestamp(1000),
        expires_at: Timestamp(2000),
        tenant: tenant.into(),
        metadata: "filename Y2hhaXIuZ2xi".into(),
    }
}

fn piece(start: u64, bytes: u64) -> Piece {
    Piece { start, bytes, name: format!("{start}") }
}

/// Runs all checks on one empty store.
pub(in crate::jobs) async fn suite(store: &impl UploadStore) {
    let mut one = upload("one", "a", 30);
    store.add_upload(&one, BOUNDS).await.unwrap();
    assert_eq!(store.upload("one").await.unwrap().as_ref(), Some(&one));
    assert_eq!(store.upload("none").await, Ok(None));

    // Only the holder adds, only behind what is here, and a newer one takes its place.
    assert_eq!(store.hold_upload("one", "h", 1).await, Ok(false));
    assert_eq!(store.hold_upload("one", "h", 0).await, Ok(true));
    assert_eq!(store.add_pieces("one", "h", &[piece(0, 10), piece(10, 5)], Timestamp(3000)).await, Ok(true));
    assert_eq!(store.add_pieces("one", "h", &[piece(10, 5)], Timestamp(4000)).await, Ok(false));
    (one.offset, one.expires_at) = (15, Timestamp(3000));
    assert_eq!(store.upload("one").await, Ok(Some(one.clone())));
    assert_eq!(store.hold_upload("one", "newer", 15).await, Ok(true));
    assert_eq!(store.add_pieces("one", "h", &[piece(15, 15)], Timestamp(4000)).await, Ok(false));
    assert_eq!(store.add_pieces("one", "newer", &[piece(15, 15)], Timestamp(3000)).await, Ok(true));
    assert_eq!(store.pieces("one").await.unwrap(), [piece(0, 10), piece(10, 5), piece(15, 15)]);
    assert_eq!(store.complete_upload("one", "ab").await, Ok(true));
    (one.offset, one.sha256, one.complete) = (30, Some("ab".into()), true);
    assert_eq!(store.upload("one").await, Ok(Some(one)));
    assert_eq!(store.hold_upload("one", "h", 30).await, Ok(false), "it is complete");
    assert_eq!(store.complete_upload("none", "ab").await, Ok(false));

    // Bounds.
    let declared = Upload { sha256: Some("cd".into()), ..upload("two", "a", 7) };
    store.add_upload(&declared, UploadBounds { incomplete: Some(1), ..BOUNDS }).await.unwrap();
    assert_eq!(store.upload("two").await, Ok(Some(declared)), "what is declared is not what is found");
    let refused = |id: &'static str, tenant: &'static str, bounds: UploadBounds| async move {
        store.add_upload(&upload(id, tenant, 1), bounds).await.unwrap_err().code
    };
    assert_eq!(refused("three", "a", BOUNDS).await, Code::QuotaExceeded);
    let incomplete = UploadBounds { of_tenant: 9, incomplete: Some(1), ..BOUNDS };
    assert_eq!(refused("three", "a", incomplete).await, Code::QuotaExceeded);
    assert_eq!(refused("three", "b", UploadBounds { all: 2, ..BOUNDS }).await, Code::QueueFull);
    store.add_upload(&upload("three", "b", 1), BOUNDS).await.unwrap();
    // Those of no tenant are bounded together alone.
    store.add_upload(&upload("four", "", 2), UploadBounds { of_tenant: 0, ..BOUNDS }).await.unwrap();
    assert_eq!(store.upload_bytes(None).await, Ok(UploadBytes { declared: 40, received: 30 }));
    assert_eq!(store.upload_bytes(Some("a")).await, Ok(UploadBytes { declared: 37, received: 30 }));
    assert_eq!(store.upload_bytes(Some("c")).await, Ok(UploadBytes::default()));

    // What has expired, and what is removed.
    let mut expired = store.expired_uploads(Timestamp(2000)).await.unwrap();
    expired.sort();
    assert_eq!(expired, ["four", "three", "two"]);
    assert_eq!(store.remove_upload("one").await, Ok(true));
    assert_eq!(store.remove_upload("one").await, Ok(false));
    assert_eq!(store.pieces("one").await, Ok(Vec::new()));
    assert_eq!(store.add_pieces("one", "newer", &[piece(30, 1)], Timestamp(9000)).await, Ok(false));
}
