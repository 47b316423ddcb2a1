//! Stage after stage: which tasks there are, which are done, which can run.

use std::collections::BTreeMap;
use std::sync::Arc;

use terrane_scene::{ClusterId, ImageId, ImagePair};
use terrane_viewgraph::Partition;

use super::predict::{self, Cost};
use super::{KnownArtefacts, Plan, PlanState, StageProgress, listing};
use crate::execute::read::{self, TableArtefact};
use crate::task::{FeatureSet, FinishedComponent, FinishedRun};
use crate::{ArtefactKey, KeyBuilder, PipelineError, RunConfig, Stage, Store, Task, TaskSpec};

/// What became of the tasks of a stage, item by item.
struct StageOutcome {
    /// The artefact of each item, or why there is none.
    items: Vec<Result<ArtefactKey, String>>,
    /// Whether every item is done or set aside.
    complete: bool,
}

impl StageOutcome {
    fn existing(&self) -> Vec<ArtefactKey> {
        self.items.iter().filter_map(|item| item.as_ref().ok().copied()).collect()
    }
}

/// A task without its stage's common fields.
struct Item {
    key: ArtefactKey,
    name: String,
    inputs: Vec<ArtefactKey>,
    cost: Cost,
    spec: TaskSpec,
}

pub(super) struct Planner<'a> {
    config: &'a RunConfig,
    store: &'a Store,
    known: &'a mut KnownArtefacts,
    ready: Vec<Task>,
    progress: Vec<StageProgress>,
    failed: Option<String>,
    pub(super) finished: Option<(ArtefactKey, FinishedRun)>,
}

/// `Ok(None)`: the stages beyond can't be planned yet.
type Step<T> = Result<Option<T>, PipelineError>;

impl<'a> Planner<'a> {
    pub fn new(config: &'a RunConfig, store: &'a Store, known: &'a mut KnownArtefacts) -> Self {
        let progress =
            Stage::ALL.map(|stage| StageProgress { stage, done: 0, total: None, set_aside: 0 }).to_vec();
        Self { config, store, known, ready: Vec::new(), progress, failed: None, finished: None }
    }

    pub fn plan(mut self) -> Result<Plan, PipelineError> {
        self.plan_stages()?;
        let state = match (&self.finished, self.failed.take()) {
            (_, Some(reason)) => PlanState::Failed { reason },
            (Some((export, _)), None) => PlanState::Finished { figures: read::figures(self.store, export)? },
            (None, None) => PlanState::Working,
        };
        if !matches!(state, PlanState::Working) {
            self.ready.clear();
        }
        Ok(Plan { ready: self.ready, progress: self.progress, state })
    }

    /// Plans as far as the artefacts allow; `finished` is set at the end of the road.
    pub fn plan_stages(&mut self) -> Step<()> {
        let Some((table_key, table)) = self.ingest()? else { return Ok(None) };
        let Some((features, lost)) = self.features(table_key, &table)? else { return Ok(None) };
        let Some((pairs_key, blocks)) = self.pairs(table_key, &table, &features, lost)? else {
            return Ok(None);
        };
        let Some(matches) = self.matching(table_key, &table, pairs_key, &blocks, &features)? else {
            return Ok(None);
        };
        let num_pairs = blocks.iter().map(Vec::len).sum::<usize>();
        let Some(view_graph) = self.view_graph(&table, &matches, num_pairs)? else { return Ok(None) };
        let Some((partition_key, partition)) = self.partition(view_graph, num_pairs)? else {
            return Ok(None);
        };
        let graph = GraphKeys { table: table_key, view_graph, partition: partition_key };
        let matched = Matched { blocks: &blocks, matches: &matches, features: &features };
        let Some(submaps) = self.submaps(&graph, &table, &partition, &matched)? else {
            return Ok(None);
        };
        let mut run = FinishedRun {
            table: table_key,
            features,
            pairs: pairs_key,
            matches: matches.iter().flatten().copied().collect(),
            view_graph,
            partition: partition_key,
            submaps: submaps.existing,
            lost_clusters: submaps.lost,
            average: None,
            components: Vec::new(),
        };
        if !run.submaps.is_empty() {
            let Some(average) = self.average(&table, &run, &submaps.seams)? else { return Ok(None) };
            run.average = Some(average);
            let Some(components) = self.components(&table, &run, average)? else { return Ok(None) };
            run.components = components;
        }
        self.export(run)
    }

    fn ingest(&mut self) -> Step<(ArtefactKey, Arc<TableArtefact>)> {
        let key_of = |config: &RunConfig, digest: &str| -> Result<ArtefactKey, PipelineError> {
            let key = KeyBuilder::new(Stage::Ingest).bytes(digest.as_bytes()).value(&config.camera)?;
            // The digest tells masks and databases apart, but not that they are asked for.
            let key = if config.masks.is_some() { key.bytes(b"masks") } else { key };
            Ok(if config.import.is_some() { key.bytes(b"import") } else { key }.finish())
        };
        let mut files = listing(self.config, self.known, false)?;
        let mut key = key_of(self.config, &files.digest)?;
        if !self.known.exists(&key) {
            files = listing(self.config, self.known, true)?;
            key = key_of(self.config, &files.digest)?;
        }
        let item = Item {
            key,
            name: format!("{} files", files.paths.len()),
            inputs: Vec::new(),
            cost: predict::ingest(files.paths.len()),
            spec: TaskSpec::Ingest { listing: files.digest },
        };
        let Some(key) = self.single(Stage::Ingest, item) else { return Ok(None) };
        let store = self.store;
        let table = self.known.remember(key, "table", || read::table(store, &key))?;
        if table.table.images.is_empty() {
            let first =
                table.table.rejected.first().map(|r| format!("{}: {}", r.path, r.reason)).unwrap_or_default();
            self.failed =
                Some(format!("none of the {} files can be used; {first}", table.table.rejected.len()));
            return Ok(None);
        }
        Ok(Some((key, table)))
    }

    fn features(
        &mut self,
        table_key: ArtefactKey,
        table: &TableArtefact,
    ) -> Step<(FeatureSet, Vec<(ImageId, u32, String)>)> {
        let options = &self.config.features;
        let per_batch = options.images_per_task.max(1);
        let (most_features, threads) = (options.extraction().most_features(), self.config.workers.threads);
        let images = &table.table.images;
        let mut items = Vec::new();
        for (batch, chunk) in images.chunks(per_batch as usize).enumerate() {
            let read = (options.images_per_task, &options.decode, options.extraction());
            let mut key = KeyBuilder::new(Stage::Features).value(&read)?;
            let first = ImageId(batch as u32 * per_batch);
            for (image, id) in chunk.iter().zip(first.0..) {
                key = key.bytes(image.content_hash.as_bytes());
                if !table.inputs.is_empty() {
                    key = key.bytes(table.inputs.digest_of(ImageId(id)).as_bytes());
                }
            }
            let count = chunk.len() as u32;
            items.push(Item {
                key: key.finish(),
                name: format!("images {} to {}", first.0, first.0 + count - 1),
                inputs: vec![table_key],
                cost: predict::features(&table.table, (first, count), most_features, threads),
                spec: TaskSpec::Features { table: table_key, first, count },
            });
        }
        let outcome = self.many(Stage::Features, items);
        if !outcome.complete {
            return Ok(None);
        }
        let mut features = FeatureSet { images_per_batch: per_batch, batches: BTreeMap::new() };
        let mut lost = Vec::new();
        for (batch, item) in outcome.items.into_iter().enumerate() {
            let first = batch as u32 * per_batch;
            match item {
                Ok(key) => {
                    features.batches.insert(batch as u32, key);
                }
                Err(reason) => {
                    lost.push((ImageId(first), per_batch.min(images.len() as u32 - first), reason))
                }
            }
        }
        Ok(Some((features, lost)))
    }

    fn pairs(
        &mut self,
        table_key: ArtefactKey,
        table: &TableArtefact,
        features: &FeatureSet,
        lost: Vec<(ImageId, u32, String)>,
    ) -> Step<(ArtefactKey, Arc<Vec<Vec<ImagePair>>>)> {
        let key = KeyBuilder::new(Stage::Pairs)
            .value(&self.config.pairs)?
            .number(self.config.seed)
            .bytes(&table.digest)
            .value(features)?
            .value(&lost)?;
        let key = with_imported_matches(key, table).finish();
        let num_images = table.table.images.len();
        let mut inputs = vec![table_key];
        inputs.extend(features.batches.values());
        let item = Item {
            key,
            name: format!("{num_images} images"),
            inputs,
            cost: predict::pairs(num_images),
            spec: TaskSpec::Pairs { table: table_key, features: features.clone(), lost },
        };
        let Some(key) = self.single(Stage::Pairs, item) else { return Ok(None) };
        let store = self.store;
        let blocks = self.known.remember(key, "blocks", || Ok(read::pairs(store, &key)?.0))?;
        Ok(Some((key, blocks)))
    }

    /// The match artefact of each block, `None` for those set aside.
    fn matching(
        &mut self,
        table_key: ArtefactKey,
        table: &TableArtefact,
        pairs_key: ArtefactKey,
        blocks: &[Vec<ImagePair>],
        features: &FeatureSet,
    ) -> Step<Vec<Option<ArtefactKey>>> {
        let mut items = Vec::new();
        for (block, pairs) in blocks.iter().enumerate() {
            let mut images: Vec<ImageId> =
                pairs.iter().flat_map(|pair| [pair.first(), pair.second()]).collect();
            images.sort();
            images.dedup();
            let most_features = self.config.features.extraction().most_features();
            let part = features.only(images.iter().copied());
            let mut key = KeyBuilder::new(Stage::Match)
                .value(&self.config.matching)?
                .number(self.config.seed)
                .number(u64::from(part.images_per_batch))
                .inputs(part.batches.values());
            for pair in pairs {
                key = key.number(u64::from(pair.first().0) << 32 | u64::from(pair.second().0));
            }
            for image in &images {
                key = key.bytes(&table.image_digests[image.index()]);
            }
            key = with_imported_matches(key, table);
            let mut inputs = vec![table_key, pairs_key];
            inputs.extend(part.batches.values());
            items.push(Item {
                key: key.finish(),
                name: format!("block {} of {}: {} pairs", block + 1, blocks.len(), pairs.len()),
                inputs,
                cost: predict::matching(
                    images.len(),
                    pairs.len(),
                    most_features,
                    self.config.workers.threads,
                ),
                spec: TaskSpec::Match {
                    table: table_key,
                    pairs: pairs_key,
                    block: block as u32,
                    features: part,
                },
            });
        }
        let outcome = self.many(Stage::Match, items);
        Ok(outcome.complete.then(|| outcome.items.into_iter().map(Result::ok).collect()))
    }

    fn view_graph(
        &mut self,
        table: &TableArtefact,
        matches: &[Option<ArtefactKey>],
        num_pairs: usize,
    ) -> Step<ArtefactKey> {
        let matches: Vec<ArtefactKey> = matches.iter().flatten().copied().collect();
        let num_images = table.table.images.len() as u32;
        let key = KeyBuilder::new(Stage::ViewGraph)
            .value(&self.config.view_graph)?
            .number(u64::from(num_images))
            .inputs(&matches)
            .finish();
        let item = Item {
            key,
            name: format!("{num_pairs} pairs"),
            inputs: matches.clone(),
            cost: predict::graph(num_pairs),
            spec: TaskSpec::ViewGraph { num_images, matches },
        };
        Ok(self.single(Stage::ViewGraph, item))
    }

    fn partition(
        &mut self,
        view_graph: ArtefactKey,
        num_pairs: usize,
    ) -> Step<(ArtefactKey, Arc<Partition>)> {
        let key = KeyBuilder::new(Stage::Partition)
            .value(&self.config.partition)?
            .number(self.config.seed)
            .input(&view_graph)
            .finish();
        let item = Item {
            key,
            name: "view graph".to_owned(),
            inputs: vec![view_graph],
            cost: predict::graph(num_pairs),
            spec: TaskSpec::Partition { view_graph },
        };
        let Some(key) = self.single(Stage::Partition, item) else { return Ok(None) };
        let store = self.store;
        let partition = self.known.remember(key, "partition", || read::partition(store, &key))?;
        Ok(Some((key, partition)))
    }

    fn single(&mut self, stage: Stage, item: Item) -> Option<ArtefactKey> {
        let name = item.name.clone();
        let mut outcome = self.many(stage, vec![item]);
        match outcome.items.pop() {
            Some(Ok(key)) if outcome.complete => Some(key),
            Some(Err(reason)) if outcome.complete => {
                self.failed = Some(format!("{stage} ({name}) failed: {reason}"));
                None
            }
            _ => None,
        }
    }

    /// Adds the items of a stage to the plan. May be called more than once for a stage.
    fn many(&mut self, stage: Stage, items: Vec<Item>) -> StageOutcome {
        let at = Stage::ALL.iter().position(|other| *other == stage).unwrap_or(0);
        let mut outcome = StageOutcome { items: Vec::with_capacity(items.len()), complete: true };
        let (mut done, mut set_aside) = (0, 0);
        let total = items.len() as u64;
        for item in items {
            if self.known.exists(&item.key) {
                done += 1;
                outcome.items.push(Ok(item.key));
            } else if let Some(reason) = self.known.reason_set_aside(&item.key) {
                done += 1;
                set_aside += 1;
                outcome.items.push(Err(reason.to_owned()));
            } else {
                outcome.complete = false;
                outcome.items.push(Ok(item.key));
                self.ready.push(Task {
                    key: item.key,
                    stage,
                    item: item.name,
                    inputs: item.inputs,
                    predicted_peak_bytes: item.cost.bytes,
                    predicted_seconds: item.cost.seconds,
                    spec: item.spec,
                });
            }
        }
        let progress = &mut self.progress[at];
        progress.done += done;
        progress.set_aside += set_aside;
        progress.total = Some(progress.total.unwrap_or(0) + total);
        outcome
    }
}

/// Adds to a key what it depends on when matches come from a database.
fn with_imported_matches(key: KeyBuilder, table: &TableArtefact) -> KeyBuilder {
    let digest = table.inputs.imported_matches().and_then(|imported| imported.matches_digest.as_ref());
    match digest {
        Some(digest) => key.bytes(digest.as_bytes()),
        None => key,
    }
}

/// Artefacts that every submap reads.
struct GraphKeys {
    table: ArtefactKey,
    view_graph: ArtefactKey,
    partition: ArtefactKey,
}

/// What submaps are made of.
struct Matched<'a> {
    blocks: &'a [Vec<ImagePair>],
    /// The match artefact of each block, `None` for those set aside.
    matches: &'a [Option<ArtefactKey>],
    features: &'a FeatureSet,
}

/// What became of the clusters and their seams.
struct Submaps {
    existing: Vec<(ClusterId, ArtefactKey)>,
    lost: Vec<(ClusterId, String)>,
    /// Places in `existing`, and the align artefact.
    seams: Vec<(u32, u32, ArtefactKey)>,
}

mod fuse;
