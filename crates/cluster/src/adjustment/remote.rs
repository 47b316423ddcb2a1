//! The solver's side: parts that other processes hold.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use terrane_pipeline::adjustment::{BundleError, CameraSide, FromHolder, FromSolver, PartHost, PartRequest};
use terrane_proto::{LinkReceiver, LinkSender, Token};
use tokio::net::TcpListener;
use tokio::runtime::Handle;
use tokio::sync::mpsc;

use crate::ClusterError;

/// How a solver waits for its holders.
#[derive(Clone, Debug)]
pub struct RemoteOptions {
    /// Holders to wait for before parts are given out.
    pub holders: u32,
    /// The token that they show.
    pub token: Option<Token>,
    /// How long parts may be without a holder before the solve is given up.
    pub patience: Duration,
}

/// Something that a holder did.
enum Event {
    Joined(u64, LinkSender),
    Said(u64, Bytes),
    Lost(u64),
}

struct Holder {
    sender: LinkSender,
    parts: Vec<u32>,
    weight: u64,
    /// Whether it knows the problem.
    ready: bool,
}

/// Parts held by other processes. Every method must be called from a thread that may block.
pub struct RemoteHost {
    side: Arc<CameraSide>,
    /// How much work each part is.
    weights: Vec<u64>,
    options: RemoteOptions,
    runtime: Handle,
    events: mpsc::Receiver<Event>,
    holders: BTreeMap<u64, Holder>,
    orphans: Vec<u32>,
    number: u64,
    step: u64,
    cameras: Vec<f64>,
    /// The questions that a part must be asked again when it is taken over, in their order.
    replay: Vec<PartRequest>,
    why_lost: String,
}

impl RemoteHost {
    /// Serves holders on a bound listener and waits until as many as expected have joined; parts are given out by weight,
    /// neighbours together. `runtime` must have threads of its own.
    ///
    /// # Errors
    /// When they do not come within the patience.
    pub fn start(
        runtime: Handle,
        listener: TcpListener,
        side: Arc<CameraSide>,
        weights: Vec<u64>,
        options: RemoteOptions,
    ) -> Result<Self, ClusterError> {
        let events = listen(&runtime, listener, options.token.clone());
        let cameras = side.flatten();
        let mut host = Self {
            side,
            orphans: (0..weights.len() as u32).collect(),
            weights,
            options,
            runtime,
            events,
            holders: BTreeMap::new(),
            number: 0,
            step: 0,
            cameras,
            replay: Vec::new(),
            why_lost: String::new(),
        };
        while host.holders.len() < host.options.holders as usize {
            match host.next_event() {
                Some(Event::Joined(id, sender)) => host.join(id, sender),
                Some(Event::Lost(id)) => {
                    host.holders.remove(&id);
                }
                Some(Event::Said(..)) => {}
                None => {
                    return Err(ClusterError::lost(format!(
                        "{} of {} holders joined within {} s: look into their logs",
                        host.holders.len(),
                        host.options.holders,
                        host.options.patience.as_secs()
                    )));
                }
            }
        }
        host.give_out().map_err(|error| ClusterError::failed(error.to_string()))?;
        Ok(host)
    }

    /// The number of holders now.
    pub fn num_holders(&self) -> usize {
        self.holders.len()
    }

    fn next_event(&mut self) -> Option<Event> {
        let (patience, events) = (self.options.patience, &mut self.events);
        self.runtime.block_on(async { tokio::time::timeout(patience, events.recv()).await.ok().flatten() })
    }

    fn join(&mut self, id: u64, sender: LinkSender) {
        self.holders.insert(id, Holder { sender, parts: Vec::new(), weight: 0, ready: false });
    }

    /// Gives the parts that nobody holds to holders: the first time in runs of about equal weight, later all to the
    /// one that has least.
    fn give_out(&mut self) -> Result<(), BundleError> {
        let orphans = std::mem::take(&mut self.orphans);
        if orphans.is_empty() {
            return Ok(());
        }
        let first = self.holders.values().all(|holder| holder.parts.is_empty());
        let mut share: BTreeMap<u64, Vec<u32>> = BTreeMap::new();
        if first {
            let ids: Vec<u64> = self.holders.keys().copied().collect();
            let total: u64 = self.weights.iter().sum::<u64>().max(1);
            let mut before = 0;
            for part in orphans {
                let weight = self.weights[part as usize];
                let at = (2 * before + weight) as u128 * ids.len() as u128 / (2 * u128::from(total));
                share.entry(ids[(at as usize).min(ids.len() - 1)]).or_default().push(part);
                before += weight;
            }
        } else if let Some(id) = self.holders.iter().min_by_key(|(id, h)| (h.weight, **id)).map(|(id, _)| *id)
        {
            share.insert(id, orphans);
        } else {
            self.orphans = orphans;
            return Ok(());
        }
        for (id, parts) in share {
            self.hand_over(id, parts)?;
        }
        Ok(())
    }

    /// Gives parts to a holder and brings them to where the solve is.
    fn hand_over(&mut self, id: u64, parts: Vec<u32>) -> Result<(), BundleError> {
        let mut messages = Vec::new();
        let Some(holder) = self.holders.get_mut(&id) else {
            self.orphans.extend(parts);
            return Ok(());
        };
        if !holder.ready {
            // A holder that knows nothing is told everything.
            let (side, step, cameras) = (self.side.clone(), self.step, self.cameras.clone());
            messages.push(FromSolver::Setup { side, step, cameras });
            holder.ready = true;
        }
        holder.weight += parts.iter().map(|part| self.weights[*part as usize]).sum::<u64>();
        holder.parts.extend_from_slice(&parts);
        messages.push(FromSolver::Take(parts.clone()));
        for request in &self.replay {
            messages.push(FromSolver::Ask { number: 0, only: Some(parts.clone()), request: request.clone() });
        }
        let sender = holder.sender.clone();
        for message in messages {
            // A holder that is gone says so by its event.
            sender.blocking_send(encode(&message)?);
        }
        Ok(())
    }

    fn lose(&mut self, id: u64) {
        if let Some(holder) = self.holders.remove(&id) {
            tracing::warn!("a holder of {} parts was lost: others take them over", holder.parts.len());
            self.orphans.extend(holder.parts);
            self.orphans.sort_unstable();
        }
    }

    /// What has to be asked again of a part that is taken over after this request.
    fn remember(&mut self, request: &PartRequest) {
        match request {
            PartRequest::Linearise { damping, .. } => {
                self.replay = vec![PartRequest::Linearise { damping: *damping, anew: true }];
            }
            PartRequest::Prepare { .. } | PartRequest::Try { .. } => {
                self.replay.retain(|old| std::mem::discriminant(old) != std::mem::discriminant(request));
                self.replay.push(request.clone());
            }
            PartRequest::Accept => self.replay.clear(),
            PartRequest::Multiply(_) | PartRequest::Solve(_) | PartRequest::Points => {}
        }
    }

    /// Asks a holder again for the answers that are missing of the parts that it has taken over.
    fn ask_again(
        &self,
        request: &PartRequest,
        answers: &[Option<Vec<f64>>],
        parts: &[u32],
    ) -> Result<(), BundleError> {
        for holder in self.holders.values() {
            let missing: Vec<u32> = parts
                .iter()
                .copied()
                .filter(|part| answers[*part as usize].is_none() && holder.parts.contains(part))
                .collect();
            if !missing.is_empty() {
                let again =
                    FromSolver::Ask { number: self.number, only: Some(missing), request: request.clone() };
                holder.sender.blocking_send(encode(&again)?);
            }
        }
        Ok(())
    }
}

impl PartHost for RemoteHost {
    fn ask(&mut self, request: &PartRequest) -> Result<Vec<Vec<f64>>, BundleError> {
        self.number += 1;
        let mut answers: Vec<Option<Vec<f64>>> = vec![None; self.weights.len()];
        let question =
            encode(&FromSolver::Ask { number: self.number, only: None, request: request.clone() })?;
        for holder in self.holders.values().filter(|holder| !holder.parts.is_empty()) {
            holder.sender.blocking_send(question.clone());
        }
        let accepting = matches!(request, PartRequest::Accept);
        if accepting {
            self.replay.clear();
        }
        while answers.iter().any(Option::is_none) {
            match self.next_event() {
                Some(Event::Said(id, bytes)) => match FromHolder::decode(&bytes) {
                    Ok(FromHolder::Answers { number, answers: given }) if number == self.number => {
                        for (part, answer) in given {
                            if let Some(place) = answers.get_mut(part as usize) {
                                *place = Some(answer);
                            }
                        }
                    }
                    Ok(FromHolder::Failed(reason)) => {
                        tracing::error!("a holder gave up: {reason}");
                        self.why_lost = reason;
                        self.lose(id);
                    }
                    Ok(_) => {}
                    Err(error) => {
                        self.why_lost = error.to_string();
                        self.lose(id);
                    }
                },
                Some(Event::Joined(id, sender)) => self.join(id, sender),
                Some(Event::Lost(id)) => self.lose(id),
                None => return Err(BundleError::lost(self.given_up())),
            }
            if !self.orphans.is_empty() && !self.holders.is_empty() {
                let parts = self.orphans.clone();
                if accepting {
                    // Who takes them over finds the points of the accepted step.
                    parts.iter().for_each(|part| answers[*part as usize] = Some(Vec::new()));
                }
                self.give_out()?;
                self.ask_again(request, &answers, &parts)?;
            }
        }
        self.remember(request);
        Ok(answers.into_iter().flatten().collect())
    }

    fn accepted(&mut self, cameras: Vec<f64>) {
        self.cameras = cameras;
        self.step += 1;
    }

    fn wants_cameras(&self) -> bool {
        true
    }
}

impl RemoteHost {
    fn given_up(&self) -> String {
        let why = if self.why_lost.is_empty() {
            String::new()
        } else {
            format!(" (the last said: {})", self.why_lost)
        };
        format!(
            "{} parts have had no answer for {} s{why}: start holders that can reach the store, or solve in one process",
            self.orphans.len(),
            self.options.patience.as_secs()
        )
    }
}

fn encode(message: &FromSolver) -> Result<Bytes, BundleError> {
    message.encode().map_err(|error| BundleError::lost(error.to_string()))
}

/// Serves holders; what they do becomes events.
fn listen(runtime: &Handle, listener: TcpListener, token: Option<Token>) -> mpsc::Receiver<Event> {
    let (events, inbox) = mpsc::channel(64);
    let (joined, mut links) = mpsc::channel(8);
    runtime.spawn(async move {
        if let Err(error) =
            terrane_proto::serve_holders(listener, token, joined, std::future::pending()).await
        {
            tracing::error!("{error}");
        }
    });
    runtime.spawn(async move {
        let mut id = 0;
        while let Some(link) = links.recv().await {
            id += 1;
            let (sender, receiver) = link.split();
            tokio::spawn(follow(id, sender, receiver, events.clone()));
        }
    });
    inbox
}

async fn follow(id: u64, sender: LinkSender, mut receiver: LinkReceiver, events: mpsc::Sender<Event>) {
    let first = receiver.receive().await.and_then(|bytes| FromHolder::decode(&bytes).ok());
    let Some(FromHolder::Joined { name }) = first else { return };
    tracing::info!("holder {name} joined");
    if events.send(Event::Joined(id, sender)).await.is_err() {
        return;
    }
    while let Some(bytes) = receiver.receive().await {
        if events.send(Event::Said(id, bytes)).await.is_err() {
            return;
        }
    }
    let _ = events.send(Event::Lost(id)).await;
}
