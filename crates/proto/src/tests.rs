//! The wire refuses what is no good, and carries the rest unchanged.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use proptest::prelude::*;

use crate::types::*;
use crate::{
    Client, ClientCalls, Endpoint, Refusal, ServeOptions, Token, WorkerCalls, convert, limits, serve, v1,
};

/// A run whose description is so long that its end is written apart.
const LONG_RUN: RunId = RunId(7);

/// Answers from its arguments, so that a test sees that they arrived.
#[derive(Default)]
struct Echo(AtomicU64);

impl WorkerCalls for Echo {
    async fn register(&self, registration: Registration) -> Result<Registered, Refusal> {
        Ok(Registered {
            worker: WorkerId(u64::from(registration.process)),
            heartbeat_ms: registration.threads,
        })
    }
    async fn describe_run(&self, run: RunId) -> Result<Bytes, Refusal> {
        if run == LONG_RUN {
            return Ok(Bytes::from(vec![b'x'; 2000]));
        }
        if run == RunId(404) {
            Err(Refusal::NotFound("run 404 is not known".into()))
        } else {
            Ok(Bytes::from(run.to_string()))
        }
    }
    async fn next_task(&self, worker: WorkerId, held: Vec<LeaseId>) -> Result<NextTask, Refusal> {
        let Some(&lease) = held.first() else { return Ok(NextTask::Nothing) };
        let key = TaskKey::parse("abc-1").map_err(|error| Refusal::Invalid(error.to_string()))?;
        let spec = Bytes::from_static(b"spec");
        Ok(NextTask::Lease(TaskLease {
            lease,
            run: RunId(worker.0),
            key,
            stage: "match".into(),
            item: "3".into(),
            attempt: 2,
            spec,
        }))
    }
    async fn heartbeat(
        &self,
        _: WorkerId,
        held: Vec<LeaseId>,
        resident_bytes: u64,
    ) -> Result<HeartbeatAnswer, Refusal> {
        self.0.store(resident_bytes, Ordering::SeqCst);
        Ok(HeartbeatAnswer { known: true, revoked: held })
    }
    async fn complete(
        &self,
        _: WorkerId,
        _: LeaseId,
        cost: TaskCost,
        report: Bytes,
    ) -> Result<bool, Refusal> {
        Ok(cost.cpu_ms == 7 && report.as_ref() == b"report")
    }
    async fn fail(&self, _: WorkerId, _: LeaseId, failure: Failure, _: TaskCost) -> Result<bool, Refusal> {
        Ok(failure.kind == FailureKind::Machine)
    }
}

impl ClientCalls for Echo {
    async fn submit(&self, description: Bytes) -> Result<RunId, Refusal> {
        Ok(RunId(description.len() as u64))
    }
    async fn status(&self) -> Result<Status, Refusal> {
        let stage =
            StageStatus { stage: "features".into(), done: 1, total: 4, running: 2, computed: 1, given_up: 0 };
        let run = RunStatus {
            run: RunId(1),
            phase: RunPhase::FellShort("no pair overlaps".into()),
            stages: vec![stage],
        };
        Ok(Status { runs: vec![run], workers: vec![] })
    }
    async fn cancel(&self, _: RunId) -> Result<bool, Refusal> {
        Ok(true)
    }
    async fn logs(&self, from: u64) -> Result<LogPage, Refusal> {
        Ok(LogPage {
            lines: vec![LogLine { number: from, at_ms: 1, text: "x".repeat(limits::TEXT_BYTES + 5) }],
            next: from + 1,
        })
    }
}

async fn with_server<F: Future<Output = ()>>(token: Option<Token>, body: impl FnOnce(String) -> F) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let served = serve(listener, Arc::new(Echo::default()), ServeOptions { token }, async move {
        let _ = stopped.await;
    });
    let server = tokio::spawn(served);
    body(url).await;
    drop(stop);
    server.await.unwrap().unwrap();
}

#[tokio::test(flavor = "current_thread")]
async fn every_call_carries_its_content() {
    with_server(None, |url| async move {
        let client = Client::connect(&Endpoint::new(url, None)).await.unwrap();
        let registration =
            Registration { name: "w".into(), memory_bytes: 5, threads: 3, slots: 1, process: 9 };
        let registered = client.register(registration).await.unwrap();
        assert_eq!(registered, Registered { worker: WorkerId(9), heartbeat_ms: 3 });
        assert_eq!(client.describe_run(RunId(12)).await.unwrap().as_ref(), b"12");
        assert!(client.describe_run(RunId(404)).await.unwrap_err().is_not_found());
        assert_eq!(client.next_task(WorkerId(1), &[]).await.unwrap(), NextTask::Nothing);
        let NextTask::Lease(lease) = client.next_task(WorkerId(4), &[LeaseId(8)]).await.unwrap() else {
            panic!("no lease")
        };
        assert_eq!(
            (lease.lease, lease.run, lease.attempt, lease.spec.as_ref()),
            (LeaseId(8), RunId(4), 2, &b"spec"[..])
        );
        assert_eq!(client.heartbeat(WorkerId(1), &[LeaseId(2)], 3).await.unwrap().revoked, vec![LeaseId(2)]);
        let cost = TaskCost { wall_ms: 1, cpu_ms: 7, peak_bytes: 2 };
        assert!(client.complete(WorkerId(1), LeaseId(2), cost, Bytes::from_static(b"report")).await.unwrap());
        let failure = Failure { kind: FailureKind::Machine, reason: "disk".into(), detail: Bytes::new() };
        assert!(client.fail(WorkerId(1), LeaseId(2), failure, cost).await.unwrap());
        assert_eq!(client.submit(Bytes::from_static(b"abcd")).await.unwrap(), RunId(4));
        assert_eq!(
            client.status().await.unwrap().runs[0].phase,
            RunPhase::FellShort("no pair overlaps".into())
        );
        assert!(client.cancel(RunId(1)).await.unwrap());
        assert_eq!(client.logs(5).await.unwrap().lines[0].text.len(), limits::TEXT_BYTES);
    })
    .await;
}

#[tokio::test(flavor = "current_thread")]
async fn a_token_is_asked_for_and_compared() {
    let token = Token::random().unwrap();
    let kept = token.clone();
    with_server(Some(token), |url| async move {
        for wrong in [None, Some(Token::random().unwrap())] {
            let refused = Client::connect(&Endpoint::new(url.clone(), wrong)).await.err().unwrap();
            assert!(refused.to_string().contains("token") && !refused.is_unreachable(), "{refused}");
        }
        assert!(Client::connect(&Endpoint::new(url, Some(kept))).await.is_ok());
    })
    .await;
}

#[tokio::test(flavor = "current_thread")]
async fn answers_do_not_wait_for_an_acknowledgement() {
    with_server(None, |url| async move {
        let client = Client::connect(&Endpoint::new(url, None)).await.unwrap();
        let mut took_ms = Vec::new();
        for _ in 0..30 {
            let asked = std::time::Instant::now();
            client.describe_run(LONG_RUN).await.unwrap();
            took_ms.push(asked.elapsed().as_millis());
        }
        took_ms.sort_unstable();
        // A delayed acknowledgement takes 40 ms; the quicker half of the calls shows it even on a busy machine.
        assert!(took_ms[15] < 35, "{took_ms:?}");
    })
    .await;
}

#[tokio::test(flavor = "current_thread")]
async fn nobody_there_and_bad_addresses_are_told_apart() {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    drop(listener);
    assert!(Client::connect(&Endpoint::new(url, None)).await.err().unwrap().is_unreachable());
    for bad in ["localhost:1", "http://", "ftp://x:1"] {
        assert!(Client::connect(&Endpoint::new(bad, None)).await.err().unwrap().is_invalid_input(), "{bad}");
    }
}

#[tokio::test(flavor = "current_thread")]
async fn too_large_a_description_is_refused_before_it_travels() {
    with_server(None, |url| async move {
        let client = Client::connect(&Endpoint::new(url, None)).await.unwrap();
        let large = Bytes::from(vec![0u8; limits::DESCRIPTION_BYTES + 1]);
        assert!(client.submit(large).await.unwrap_err().is_invalid_input());
    })
    .await;
}

#[test]
fn fields_out_of_range_are_named() {
    let good = v1::RegisterRequest { name: "w".into(), memory_bytes: 1, threads: 1, slots: 1, process: 1 };
    assert!(Registration::try_from(good.clone()).is_ok());
    let cases = [
        ("name", v1::RegisterRequest { name: String::new(), ..good.clone() }),
        ("name", v1::RegisterRequest { name: "a\nb".into(), ..good.clone() }),
        ("name", v1::RegisterRequest { name: "x".repeat(limits::NAME_BYTES + 1), ..good.clone() }),
        ("threads", v1::RegisterRequest { threads: 0, ..good.clone() }),
        ("slots", v1::RegisterRequest { slots: u32::MAX, ..good }),
    ];
    for (path, wire) in cases {
        let error = Registration::try_from(wire).unwrap_err();
        assert!(error.to_string().starts_with(path), "{error}");
    }
    assert!(NextTask::try_from(v1::NextTaskReply { answer: None }).is_err());
    assert!(convert::failure(0, String::new(), Bytes::new()).is_err());
    assert!(convert::failure(99, String::new(), Bytes::new()).is_err());
    assert!(convert::cost(None).is_err());
    assert!(convert::leases("held", vec![0; limits::LEASES + 1]).is_err());
    assert!(RunStatus::try_from(v1::RunStatus { phase: 77, ..Default::default() }).is_err());
}

#[test]
fn keys_are_never_paths() {
    for bad in ["", "../x", "/a", "a//b", "a/", "a.b", "a b", "ä", &"x".repeat(limits::KEY_CHARS + 1)] {
        assert!(TaskKey::parse(bad).is_err(), "{bad}");
    }
    assert_eq!(TaskKey::parse("submap/0fA-_").unwrap().as_str(), "submap/0fA-_");
}

proptest! {
    #[test]
    fn leases_survive_the_round_trip(lease: u64, run: u64, attempt: u32, key in "[a-z0-9]{1,64}", stage in ".{0,40}", spec: Vec<u8>) {
        let own = TaskLease { lease: LeaseId(lease), run: RunId(run), key: TaskKey::parse(&key).unwrap(), stage, item: "i".into(), attempt, spec: spec.into() };
        prop_assert_eq!(TaskLease::try_from(v1::TaskLease::from(own.clone())).unwrap(), own);
    }

    #[test]
    fn clipping_keeps_whole_characters(text in "\\PC{0,60}", most in 0usize..80) {
        let clipped = convert::clip(text.clone(), most);
        prop_assert!(clipped.len() <= most && text.starts_with(&clipped));
    }
}
