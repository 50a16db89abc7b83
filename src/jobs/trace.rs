//! One trace for each job: the context that requests bring and webhooks take along (W3C Trace Context), and the spans that are told to a
//! collector, where there is one.

use std::sync::{Arc, OnceLock};
use std::time::SystemTime;

use super::hub::Reporter;
use super::queue::{AttemptEnd, Claim};
use super::record::Timestamp;

/// The name of the header.
pub const TRACEPARENT: &str = "traceparent";

/// A span of a trace, as others may refer to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceContext {
    /// The trace.
    pub trace: [u8; 16],
    /// The span.
    pub span: [u8; 8],
    /// Whether the trace is wanted by whoever began it.
    pub sampled: bool,
}

impl TraceContext {
    /// A trace that begins here.
    pub fn root() -> Self {
        TraceContext { trace: random(), span: random(), sampled: true }
    }

    /// What a `traceparent` says; `None` where it is none (then a trace begins).
    pub fn parse(text: &str) -> Option<Self> {
        let mut parts = text.trim().split('-');
        let (version, trace, span, flags) = (parts.next()?, parts.next()?, parts.next()?, parts.next()?);
        let lower = |part: &str, length: usize| {
            part.len() == length && part.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
        };
        // Later versions may say more behind it; this one says nothing.
        let known = lower(version, 2) && version != "ff" && (version != "00" || parts.next().is_none());
        if !(known && lower(trace, 32) && lower(span, 16) && lower(flags, 2)) {
            return None;
        }
        let mut context = TraceContext { trace: [0; 16], span: [0; 8], sampled: false };
        hex::decode_to_slice(trace, &mut context.trace).ok()?;
        hex::decode_to_slice(span, &mut context.span).ok()?;
        context.sampled = u8::from_str_radix(flags, 16).ok()? & 1 == 1;
        (context.trace != [0; 16] && context.span != [0; 8]).then_some(context)
    }

    /// A new span of the same trace.
    pub fn child(self) -> Self {
        TraceContext { span: random(), ..self }
    }

    /// The trace's id in hexadecimal digits.
    pub fn trace_id(self) -> String {
        hex::encode(self.trace)
    }

    /// The span's id in hexadecimal digits.
    pub fn span_id(self) -> String {
        hex::encode(self.span)
    }
}

impl std::fmt::Display for TraceContext {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "00-{}-{}-{:02x}", self.trace_id(), self.span_id(), u8::from(self.sampled))
    }
}

/// Random bits, of which not all are 0. Where the system has none, ids may be the same: nothing but the trace suffers.
fn random<const N: usize>() -> [u8; N] {
    let mut bytes = [0; N];
    if getrandom::fill(&mut bytes).is_err() || bytes == [0; N] {
        bytes = [1; N];
    }
    bytes
}

/// What a span is to those beside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpanKind {
    /// A request is answered.
    Server,
    /// Something that was queued is worked on.
    Consumer,
    /// A request is sent.
    Client,
    /// A part of another.
    Internal,
}

/// A span that has ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Span {
    /// Its name.
    pub name: String,
    /// What it is.
    pub kind: SpanKind,
    /// Its place.
    pub context: TraceContext,
    /// The span that it belongs to.
    pub parent: Option<[u8; 8]>,
    /// When it began.
    pub start: SystemTime,
    /// When it ended.
    pub end: SystemTime,
    /// What is known of it.
    pub attributes: Vec<(&'static str, String)>,
    /// Why it failed.
    pub error: Option<String>,
}

/// Who is told of spans.
pub trait SpanSink: Send + Sync {
    /// Takes a span; it does not wait.
    fn take(&self, span: Span);

    /// Passes on what was taken, before the process ends; it may wait.
    fn flush(&self);
}

/// Tells of spans, where somebody wants to hear of them.
#[derive(Default)]
pub struct Spans(OnceLock<Arc<dyn SpanSink>>);

impl Spans {
    /// From now on they are told to `sink`; false where another has that place.
    pub fn send_to(&self, sink: Arc<dyn SpanSink>) -> bool {
        self.0.set(sink).is_ok()
    }

    /// Tells of a span, if its trace is wanted.
    pub fn tell(&self, span: impl FnOnce() -> Span, context: TraceContext) {
        if let Some(sink) = self.0.get().filter(|_| context.sampled) {
            sink.take(span());
        }
    }

    /// Passes on what was told.
    pub fn flush(&self) {
        if let Some(sink) = self.0.get() {
            sink.flush();
        }
    }
}

/// A time of the queue.
pub(super) fn system_time(time: Timestamp) -> SystemTime {
    SystemTime::UNIX_EPOCH + std::time::Duration::from_millis(u64::try_from(time.0).unwrap_or(0))
}

/// The trace of an attempt: its own span, in that of the request which brought the job.
#[derive(Debug, Clone, Copy)]
pub(super) struct AttemptTrace {
    pub(super) context: TraceContext,
    parent: Option<[u8; 8]>,
    start: SystemTime,
}

impl AttemptTrace {
    pub(super) fn new(claim: &Claim) -> Self {
        let parent = claim.trace.as_deref().and_then(TraceContext::parse);
        let context = parent.map_or_else(TraceContext::root, TraceContext::child);
        AttemptTrace { context, parent: parent.map(|parent| parent.span), start: SystemTime::now() }
    }

    /// Tells of the attempt: how long its job had waited, its stages, and all of it. Without an end its job runs again.
    pub(super) fn tell(&self, spans: &Spans, claim: &Claim, reporter: &Reporter, end: Option<&AttemptEnd>) {
        let (context, now) = (self.context, SystemTime::now());
        let part = |name: String, kind: SpanKind, start: SystemTime, end: SystemTime| Span {
            name,
            kind,
            context: context.child(),
            parent: Some(context.span),
            start,
            end: end.max(start),
            attributes: vec![("intarsia.job.id", claim.id.clone())],
            error: None,
        };
        let wait = || Span {
            parent: self.parent,
            ..part("queue wait".to_owned(), SpanKind::Internal, system_time(claim.queued_at), self.start)
        };
        spans.tell(wait, context);
        let stages = reporter.entered();
        for (n, (stage, start)) in stages.iter().enumerate() {
            let until = stages.get(n + 1).map_or(now, |next| next.1);
            spans.tell(|| part(format!("stage {stage}"), SpanKind::Internal, *start, until), context);
        }
        let whole = || {
            let mut span = part("job".to_owned(), SpanKind::Consumer, self.start, now);
            (span.context, span.parent) = (context, self.parent);
            span.attributes.push(("intarsia.job.attempt", claim.attempt.to_string()));
            span.attributes.push(("intarsia.job.state", end.map_or("queued", |end| end.state.as_str()).to_owned()));
            let error = end.and_then(|end| end.error.as_ref());
            if let Some(error) = error {
                span.attributes.push(("error.type", error.code.as_str().to_owned()));
            }
            span.error = error.map(|error| error.message.clone());
            span
        };
        spans.tell(whole, context);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    #[test]
    fn contexts_are_read_and_written_as_w3c_says() {
        let text = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";
        let context = TraceContext::parse(text).unwrap();
        assert_eq!((context.to_string().as_str(), context.sampled), (text, true));
        let child = context.child();
        assert!(child.trace == context.trace && child.span != context.span);
        assert!(!TraceContext::parse(&text.replace("-01", "-00")).unwrap().sampled);
        assert!(TraceContext::parse(&format!("01{}-more", &text[2..])).is_some(), "a later version");
        for bad in [
            "",
            "00",
            &text.to_uppercase(),
            &text.replace("00-", "ff-"),
            &format!("{text}-more"),
            "00-00000000000000000000000000000000-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-0000000000000000-01",
            &text[1..],
        ] {
            assert_eq!(TraceContext::parse(bad), None, "{bad}");
        }
        assert_ne!(TraceContext::root().trace, TraceContext::root().trace);
    }

    #[derive(Default)]
    struct Told(Mutex<Vec<Span>>);

    impl SpanSink for Told {
        fn take(&self, span: Span) {
            self.0.lock().unwrap().push(span);
        }

        fn flush(&self) {}
    }

    #[test]
    fn only_traces_that_are_wanted_are_told() {
        let (spans, told) = (Spans::default(), Arc::new(Told::default()));
        let span = |context: TraceContext| Span {
            name: "n".into(),
            kind: SpanKind::Internal,
            context,
            parent: None,
            start: SystemTime::UNIX_EPOCH,
            end: SystemTime::UNIX_EPOCH,
            attributes: Vec::new(),
            error: None,
        };
        let wanted = TraceContext::root();
        spans.tell(|| panic!("nobody hears of it"), wanted);
        assert!(spans.send_to(told.clone()) && !spans.send_to(told.clone()));
        let unwanted = TraceContext { sampled: false, ..wanted };
        spans.tell(|| panic!("it is not wanted"), unwanted);
        spans.tell(|| span(wanted), wanted);
        assert_eq!(told.0.lock().unwrap().len(), 1);
    }
}
