//! Against receivers on this machine, with a clock that the tests move.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Mutex;

use axum::Router;
use axum::extract::{Request, State};
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde_json::{Value, json};

use super::*;
use crate::jobs::queue::postgres::testing::Databases;
use crate::jobs::queue::sqlite::Sqlite;
use crate::jobs::queue::{AttemptEnd, AttemptStatus, Capacity, NewJob, Queue};
use crate::jobs::record::JobState;
use crate::jobs::webhooks::{DeliveryState, Replayed, Webhook, WebhookEvent, new_secret};

/// What a receiver was told.
struct Told {
    path: String,
    headers: HeaderMap,
    body: String,
    answered: u16,
}

impl Told {
    fn header(&self, name: &str) -> &str {
        self.headers[name].to_str().unwrap()
    }

    fn id(&self) -> &str {
        self.header(HEADER_WEBHOOK_ID)
    }

    /// Whether the reference library signs it so.
    fn signed_by(&self, secret: &str) -> bool {
        let at = self.header(HEADER_WEBHOOK_TIMESTAMP).parse().unwrap();
        let wanted = Signer::new(secret).unwrap().sign(self.id(), at, self.body.as_bytes()).unwrap();
        self.header(HEADER_WEBHOOK_SIGNATURE).split(' ').any(|signature| signature == wanted)
    }
}

/// A receiver that answers as it is told to.
#[derive(Clone)]
struct Receiver {
    address: SocketAddr,
    told: Arc<Mutex<Vec<Told>>>,
    answer: Arc<Mutex<u16>>,
}

impl Receiver {
    async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let receiver = Receiver { address, told: Arc::default(), answer: Arc::new(Mutex::new(200)) };
        let service = Router::new().fallback(receive).with_state(receiver.clone());
        tokio::spawn(async move { axum::serve(listener, service).await });
        receiver
    }

    fn url(&self) -> String {
        format!("http://{}/hook?a=1", self.address)
    }

    fn answers(&self, status: u16) {
        *self.answer.lock().unwrap() = status;
    }

    fn count(&self) -> usize {
        self.told.lock().unwrap().len()
    }
}

async fn receive(State(receiver): State<Receiver>, uri: Uri, request: Request) -> Response {
    let (head, body) = request.into_parts();
    let body = axum::body::to_bytes(body, 1 << 20).await.unwrap();
    let answered = *receiver.answer.lock().unwrap();
    let body = String::from_utf8(body.to_vec()).unwrap();
    receiver.told.lock().unwrap().push(Told { path: uri.to_string(), headers: head.headers, body, answered });
    (StatusCode::from_u16(answered).unwrap(), [("location", format!("http://{}/elsewhere", receiver.address))])
        .into_response()
}

/// A queue with its outbox.
trait Outbox: Queue + WebhookStore {}

impl<Q: Queue + WebhookStore> Outbox for Q {}

/// What the queue is made of.
enum Backend {
    Sqlite,
    Postgres(Databases),
}

struct Setup {
    _root: tempfile::TempDir,
    queue: Arc<dyn Outbox>,
    deliverer: Deliverer,
}

impl Backend {
    async fn setup(&self, allow: &[&str]) -> Setup {
        let root = tempfile::tempdir().unwrap();
        let settings = Webhooks {
            webhook_allow: allow.iter().map(|net| net.parse().unwrap()).collect(),
            webhook_secret: vec![new_secret().unwrap().parse().unwrap()],
        };
        match self {
            Backend::Sqlite => {
                let queue = Sqlite::open(&root.path().join("q")).await.unwrap();
                Setup::new(root, queue, &settings)
            }
            Backend::Postgres(databases) => Setup::new(root, databases.queue().await, &settings),
        }
    }
}

impl Setup {
    fn new<Q: Outbox + 'static>(root: tempfile::TempDir, queue: Q, settings: &Webhooks) -> Setup {
        let queue = Arc::new(queue);
        let deliverer = Deliverer::new(queue.clone(), settings).unwrap();
        Setup { _root: root, queue, deliverer }
    }

    async fn webhook(&self, tenant: &str, id: &str, url: String, events: &[WebhookEvent]) -> String {
        let secret = new_secret().unwrap();
        let (id, events, created_at) = (id.to_owned(), events.to_vec(), Timestamp::now());
        let webhook = Webhook { id, url, events, created_at, disabled_at: None, disabled_because: None };
        assert!(self.queue.add_webhook(tenant, &webhook, &secret).await.unwrap());
        secret
    }

    async fn submit(&self, tenant: &str, id: &str, options: Value) {
        let job = NewJob { tenant: tenant.into(), id: id.into(), options, ..NewJob::default() };
        self.queue.submit(&job, 99).await.unwrap();
    }

    /// Submits a job and ends it.
    async fn ended(&self, tenant: &str, id: &str, state: JobState) {
        self.submit(tenant, id, json!({"metadata": {"ticket": 7}})).await;
        self.end(state).await;
    }

    async fn end(&self, state: JobState) {
        let claim = self.queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
        let status = AttemptStatus::default();
        let end = AttemptEnd { state, error: None, outcome: None, artifacts: Vec::new(), status, timings: Vec::new() };
        assert!(self.queue.finish(&claim, &end, LEASE).await.unwrap());
    }

    /// The deliveries of a receiver, the oldest first, with their states.
    async fn states(&self, tenant: &str, webhook: &str) -> Vec<(String, DeliveryState, u32)> {
        let (page, _) = self.queue.deliveries(tenant, webhook, None, 99).await.unwrap().unwrap();
        page.into_iter().rev().map(|d| (d.event, d.state, d.attempts)).collect()
    }
}

fn later(seconds: u64) -> Timestamp {
    Timestamp::now().plus(Duration::from_secs(seconds))
}

async fn a_receiver_that_is_down_for_an_hour_gets_each_event_once(on: &Backend) {
    let setup = on.setup(&["127.0.0.0/8"]).await;
    let receiver = Receiver::start().await;
    let secret = setup.webhook("a", "hook", receiver.url(), &WebhookEvent::ALL).await;
    for id in ["one", "two", "three"] {
        setup.ended("a", id, JobState::Succeeded).await;
    }
    setup.ended("b", "other", JobState::Succeeded).await;
    receiver.answers(503);
    let start = Timestamp::now();
    for step in 0..4 * 120 {
        let since = Duration::from_secs(step * 30);
        receiver.answers(if since < Duration::from_secs(3600) { 503 } else { 204 });
        setup.deliverer.round(start.plus(since)).await.unwrap();
    }
    let told = receiver.told.lock().unwrap();
    let mut by_id: BTreeMap<&str, Vec<&Told>> = BTreeMap::new();
    for told in told.iter() {
        assert!(told.signed_by(&secret) && told.path == "/hook?a=1");
        by_id.entry(told.id()).or_default().push(told);
    }
    assert_eq!(by_id.len(), 3, "one id an event, whatever the attempt");
    let mut jobs = Vec::new();
    for attempts in by_id.values() {
        let (last, before) = attempts.split_last().unwrap();
        assert!(last.answered == 204 && before.iter().all(|told| told.answered == 503) && before.len() >= 3);
        let times: Vec<&str> = attempts.iter().map(|told| told.header(HEADER_WEBHOOK_TIMESTAMP)).collect();
        assert!(times.is_sorted() && attempts.iter().all(|told| told.body == last.body));
        let body: Value = serde_json::from_str(&last.body).unwrap();
        assert_eq!((&body["type"], &body["data"]["metadata"]), (&json!("job.succeeded"), &json!({"ticket": 7})));
        assert!(body["timestamp"].as_str().unwrap().ends_with('Z'));
        jobs.push(body["data"]["id"].as_str().unwrap().to_owned());
    }
    jobs.sort();
    assert_eq!(jobs, ["one", "three", "two"], "and nothing of another tenant's");
}

async fn the_reference_library_verifies_what_is_sent_also_while_secrets_rotate(on: &Backend) {
    let setup = on.setup(&["127.0.0.0/8"]).await;
    let receiver = Receiver::start().await;
    let old = setup.webhook("a", "hook", receiver.url(), &WebhookEvent::ALL).await;
    let new = new_secret().unwrap();
    assert_eq!(setup.queue.rotate_secret("b", "hook", &new, later(60)).await, Ok(false), "another tenant's");
    assert_eq!(setup.queue.rotate_secret("a", "hook", &new, later(60)).await, Ok(true));
    for (id, seconds) in [("one", 1), ("two", 120)] {
        setup.ended("a", id, JobState::Succeeded).await;
        assert_eq!(setup.deliverer.round(later(seconds)).await, Ok(1));
    }
    let told = receiver.told.lock().unwrap();
    for secret in [&old, &new] {
        Signer::new(secret).unwrap().verify(told[0].body.as_bytes(), &told[0].headers).unwrap();
    }
    assert!(told[1].signed_by(&new) && !told[1].signed_by(&old), "the time of the old one is up");
    let forged = told[0].body.replace("succeeded", "failed");
    assert!(Signer::new(&new).unwrap().verify(forged.as_bytes(), &told[0].headers).is_err());
}

async fn whatever_ends_a_job_is_told_and_nothing_else(on: &Backend) {
    let setup = on.setup(&["127.0.0.0/8"]).await;
    let receiver = Receiver::start().await;
    setup.webhook("a", "all", receiver.url(), &WebhookEvent::ALL).await;
    setup.webhook("a", "failures", receiver.url(), &[WebhookEvent::Failed]).await;
    setup.ended("a", "one", JobState::Succeeded).await;
    setup.ended("a", "two", JobState::Failed).await;
    setup.submit("a", "three", Value::Null).await;
    setup.queue.cancel("three").await.unwrap();
    setup.submit("a", "four", Value::Null).await;
    setup.queue.expire(later(9)).await.unwrap();
    setup.submit("a", "five", Value::Null).await;
    setup.queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
    setup.queue.cancel("five").await.unwrap();
    setup.queue.recover(Some("w"), "me").await.unwrap();
    setup.submit("a", "six", Value::Null).await;
    setup.queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
    setup.queue.recover(Some("w"), "me").await.unwrap();
    while setup.deliverer.round(later(1)).await.unwrap() > 0 {}
    let events: Vec<String> = setup.states("a", "all").await.into_iter().map(|d| d.0).collect();
    assert_eq!(events, ["job.succeeded", "job.failed", "job.canceled", "job.expired", "job.canceled"]);
    let done = |event: &str| (event.to_owned(), DeliveryState::Delivered, 1);
    assert_eq!(setup.states("a", "failures").await, [done("job.failed")]);
    assert_eq!(receiver.count(), 6);
    // Told once more when its owner wants that, under the same id.
    let (page, _) = setup.queue.deliveries("a", "failures", None, 9).await.unwrap().unwrap();
    assert_eq!(setup.queue.replay("b", "failures", &page[0].id, later(0)).await, Ok(Replayed::Unknown));
    assert_eq!(setup.queue.replay("a", "failures", &page[0].id, later(0)).await, Ok(Replayed::Yes));
    assert_eq!(setup.deliverer.round(later(1)).await, Ok(1));
    assert_eq!(receiver.told.lock().unwrap().last().unwrap().id(), page[0].id);
    assert_eq!(setup.queue.deliveries("b", "failures", None, 9).await, Ok(None), "another tenant's");
    assert_eq!(setup.queue.purge_deliveries(later(60)).await, Ok(6));
}

async fn a_receiver_that_is_gone_is_told_nothing_more(on: &Backend) {
    let setup = on.setup(&["127.0.0.0/8"]).await;
    let receiver = Receiver::start().await;
    setup.webhook("a", "hook", receiver.url(), &WebhookEvent::ALL).await;
    receiver.answers(410);
    setup.ended("a", "one", JobState::Succeeded).await;
    setup.deliverer.round(later(1)).await.unwrap();
    setup.ended("a", "two", JobState::Succeeded).await;
    assert_eq!(setup.deliverer.round(later(9_999_999)).await, Ok(0));
    let hooks = setup.queue.webhooks("a").await.unwrap();
    assert!(hooks[0].disabled_at.is_some() && hooks[0].disabled_because.as_ref().unwrap().contains("410"));
    let (page, _) = setup.queue.deliveries("a", "hook", None, 9).await.unwrap().unwrap();
    assert_eq!((page.len(), page[0].state, page[0].status), (1, DeliveryState::Failed, Some(410)));
    assert_eq!(setup.queue.replay("a", "hook", &page[0].id, later(1)).await, Ok(Replayed::Disabled));
    assert_eq!(setup.queue.remove_webhook("b", "hook").await, Ok(false), "another tenant's");
    assert_eq!(setup.queue.remove_webhook("a", "hook").await, Ok(true));
}

async fn private_addresses_are_refused_when_they_are_connected_to_and_redirects_lead_nowhere(on: &Backend) {
    let receiver = Receiver::start().await;
    let port = receiver.address.port();
    let careful = on.setup(&[]).await;
    for url in [format!("http://127.0.0.1:{port}/"), format!("http://[::ffff:127.0.0.1]:{port}/")] {
        assert!(careful.deliverer.check_url(&url).is_err(), "{url}");
    }
    // A name, and a way to write an address, that show what they lead to only when they are looked up.
    for (n, host) in ["localhost", "0x7f.1", "2130706433"].into_iter().enumerate() {
        let (id, url) = (format!("hook{n}"), format!("http://{host}:{port}/"));
        careful.deliverer.check_url(&url).unwrap();
        careful.webhook("a", &id, url, &[WebhookEvent::Succeeded]).await;
    }
    careful.ended("a", "one", JobState::Succeeded).await;
    assert_eq!(careful.deliverer.round(later(1)).await, Ok(3));
    assert_eq!(receiver.count(), 0);
    let (page, _) = careful.queue.deliveries("a", "hook0", None, 9).await.unwrap().unwrap();
    let why = page[0].error.as_ref().unwrap();
    assert!(why.contains("not an address of the open internet") && page[0].state == DeliveryState::Pending, "{why}");

    let open = on.setup(&["127.0.0.1/32"]).await;
    open.webhook("a", "hook", receiver.url(), &[WebhookEvent::Succeeded]).await;
    receiver.answers(302);
    open.ended("a", "one", JobState::Succeeded).await;
    open.deliverer.round(later(1)).await.unwrap();
    assert_eq!(receiver.count(), 1, "the redirect is not followed");
    assert_eq!(open.states("a", "hook").await, [("job.succeeded".to_owned(), DeliveryState::Pending, 1)]);
    // After three days it is given up.
    let mut attempts = 1;
    while open.deliverer.round(later(attempts * 2 * 86_400)).await.unwrap() > 0 {
        attempts += 1;
    }
    assert_eq!((receiver.count(), attempts), (10, 10));
    assert_eq!(open.states("a", "hook").await, [("job.succeeded".to_owned(), DeliveryState::Failed, 10)]);
}

async fn a_job_may_name_where_it_is_told_and_each_tenant_has_its_own_secret(on: &Backend) {
    let setup = on.setup(&["127.0.0.0/8"]).await;
    let receiver = Receiver::start().await;
    for (tenant, id) in [("", "one"), ("a", "two"), ("b", "three")] {
        setup.submit(tenant, id, json!({"webhook": receiver.url()})).await;
        setup.end(JobState::Succeeded).await;
        setup.deliverer.round(later(1)).await.unwrap();
    }
    let told = receiver.told.lock().unwrap();
    let secrets = ["", "a", "b"].map(|tenant| setup.deliverer.job_secret(tenant).unwrap());
    for (n, told) in told.iter().enumerate() {
        let by: Vec<bool> = secrets.iter().map(|secret| told.signed_by(secret)).collect();
        assert_eq!(by, [0, 1, 2].map(|secret| secret == n));
    }
    assert_eq!(told.len(), 3);
    let bad = Webhooks { webhook_secret: vec!["short".parse().unwrap()], ..Webhooks::default() };
    assert!(Deliverer::new(setup.queue.clone(), &bad).is_err_and(|failure| !failure.message.contains("short")));
}

macro_rules! on_each_backend {
    ($($test:ident)*) => {
        mod on_sqlite {
            $(#[tokio::test]
            async fn $test() {
                super::$test(&super::Backend::Sqlite).await;
            })*
        }

        #[tokio::test]
        async fn all_of_it_on_postgres() {
            let Some(databases) = Databases::start() else { return };
            let on = Backend::Postgres(databases);
            $($test(&on).await;)*
        }
    };
}

on_each_backend! {
    a_receiver_that_is_down_for_an_hour_gets_each_event_once
    the_reference_library_verifies_what_is_sent_also_while_secrets_rotate
    whatever_ends_a_job_is_told_and_nothing_else
    a_receiver_that_is_gone_is_told_nothing_more
    private_addresses_are_refused_when_they_are_connected_to_and_redirects_lead_nowhere
    a_job_may_name_where_it_is_told_and_each_tenant_has_its_own_secret
}
