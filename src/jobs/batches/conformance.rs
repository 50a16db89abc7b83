//! What every store of batches must do.

use serde_json::json;

use super::*;
use crate::jobs::queue::{Capacity, Queue};

fn job(id: &str) -> NewJob {
    NewJob { id: id.into(), options: json!({"recipe": "pack"}), tenant: "a".into(), ..NewJob::default() }
}

fn keyed(id: &str, key: &str, fingerprint: &str) -> NewJob {
    NewJob { key: Some((key.into(), fingerprint.into())), ..job(id) }
}

fn batch(id: &str, jobs: Vec<NewJob>) -> NewBatch {
    NewBatch { id: id.into(), tenant: "a".into(), metadata: json!({"night": 1}), key: None, jobs }
}

/// Runs all checks on one empty store, which is the queue too.
pub(in crate::jobs) async fn suite(store: &(impl BatchStore + Queue)) {
    let states = async |id: &str| -> Vec<(String, bool, Option<JobState>)> {
        let items = store.batch(id).await.unwrap().unwrap().items;
        items.into_iter().map(|item| (item.id, item.made, item.job.map(|job| job.state))).collect()
    };
    let waiting = async || store.counts().await.unwrap().iter().map(|(_, n)| n).sum::<u64>();
    let queued = |id: &str, made| (id.to_owned(), made, Some(JobState::Queued));

    // All of it is stored, in order, and claimed like other jobs.
    let first = batch("one", vec![job("1"), keyed("2", "k", "f"), job("3")]);
    assert_eq!(store.submit_batch(&first, 9).await, Ok(BatchSubmitted::New(vec![Submitted::New; 3])));
    assert_eq!(states("one").await, [queued("1", true), queued("2", true), queued("3", true)]);
    let stored = store.batch("one").await.unwrap().unwrap();
    assert_eq!((stored.metadata, store.batch("none").await), (json!({"night": 1}), Ok(None)));
    assert_eq!(store.tenant_of_batch("one").await, Ok(Some("a".into())));
    assert_eq!(store.tenant_of_batch("none").await, Ok(None));

    // A job that is known by its key is that job; one of another request, and nothing is stored.
    let second = batch("two", vec![job("4"), keyed("5", "k", "f")]);
    let known = Submitted::Known("2".into());
    assert_eq!(store.submit_batch(&second, 9).await, Ok(BatchSubmitted::New(vec![Submitted::New, known])));
    assert_eq!(states("two").await, [queued("4", true), queued("2", false)]);
    let refused = store.submit_batch(&batch("three", vec![job("6"), keyed("7", "k", "other")]), 9).await.unwrap_err();
    assert_eq!(refused.code, Code::IdempotencyMismatch);
    assert_eq!(refused.pointer.as_deref(), Some("/items/1/idempotency_key"));
    assert_eq!((store.batch("three").await, waiting().await), (Ok(None), 4));

    // Room for all, or for none.
    let three = || vec![job("8"), job("9"), job("10")];
    assert_eq!(store.submit_batch(&batch("full", three()), 6).await.unwrap_err().code, Code::QueueFull);
    let quota = three().into_iter().map(|job| NewJob { max_queued: Some(6), ..job }).collect();
    assert_eq!(store.submit_batch(&batch("full", quota), 9).await.unwrap_err().code, Code::QuotaExceeded);
    assert_eq!((store.batch("full").await, waiting().await), (Ok(None), 4));

    // A key of the whole.
    let with_key = |id: &str, job_id: &str, fingerprint: &str| NewBatch {
        key: Some(("build".into(), fingerprint.into())),
        ..batch(id, vec![job(job_id)])
    };
    assert_eq!(
        store.submit_batch(&with_key("four", "11", "f"), 9).await,
        Ok(BatchSubmitted::New(vec![Submitted::New]))
    );
    assert_eq!(store.submit_batch(&with_key("five", "12", "f"), 9).await, Ok(BatchSubmitted::Known("four".into())));
    let refused = store.submit_batch(&with_key("six", "13", "g"), 9).await.unwrap_err();
    assert_eq!((refused.code, waiting().await), (Code::IdempotencyMismatch, 5));
    let other = NewBatch { tenant: "b".into(), ..with_key("seven", "14", "g") };
    assert_eq!(store.submit_batch(&other, 9).await, Ok(BatchSubmitted::New(vec![Submitted::New])), "another tenant's");

    // It stays while one of its jobs is there.
    let later = Timestamp::now().plus(Duration::from_secs(60));
    assert_eq!(store.claim("w", Duration::from_secs(60), Capacity::ANY).await.unwrap().unwrap().id, "1");
    assert_eq!(store.delete("11").await, Ok(true));
    assert_eq!(states("four").await, [("11".to_owned(), true, None)]);
    assert_eq!(store.purge_batches(Timestamp(0)).await, Ok(0));
    assert_eq!(store.purge_batches(later).await, Ok(1));
    assert_eq!((store.batch("four").await, states("one").await[0].2), (Ok(None), Some(JobState::Running)));
    assert_eq!(store.delete_batch("one").await, Ok(true));
    assert_eq!(store.delete_batch("one").await, Ok(false));
    assert_eq!(states("two").await.len(), 2);
}
