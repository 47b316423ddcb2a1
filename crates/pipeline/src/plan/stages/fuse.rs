//! The stages from submaps to the report.

use super::*;

impl Planner<'_> {
    /// Submaps, and each seam as soon as both of its submaps are there.
    pub(super) fn submaps(
        &mut self,
        graph: &GraphKeys,
        table: &TableArtefact,
        partition: &Arc<Partition>,
        matched: &Matched<'_>,
    ) -> Step<Submaps> {
        let blocks_of = self.known.remember(graph.partition, "blocks of clusters", || {
            Ok(blocks_of_clusters(partition, table.table.images.len(), matched.blocks))
        })?;
        let mut items = Vec::new();
        for cluster in &partition.clusters {
            let wanted: Vec<ArtefactKey> = blocks_of[cluster.id.index()]
                .iter()
                .filter_map(|block| matched.matches[*block as usize])
                .collect();
            let part = matched.features.only(cluster.images.iter().copied());
            let key = KeyBuilder::new(Stage::Submap)
                .value(&self.config.mapping)?
                .number(self.config.seed)
                .bytes(&table.digest)
                .input(&graph.partition)
                .number(u64::from(cluster.id.0))
                .finish();
            let mut inputs = vec![graph.table, graph.view_graph, graph.partition];
            inputs.extend(part.batches.values());
            inputs.extend(&wanted);
            items.push(Item {
                key,
                name: format!(
                    "cluster {} of {}: {} images",
                    cluster.id.0 + 1,
                    partition.clusters.len(),
                    cluster.images.len()
                ),
                inputs,
                cost: predict::submap(cluster.images.len()),
                spec: TaskSpec::Submap {
                    table: graph.table,
                    view_graph: graph.view_graph,
                    partition: graph.partition,
                    cluster: cluster.id,
                    features: part,
                    matches: wanted,
                },
            });
        }
        let outcome = self.many(Stage::Submap, items);
        self.seams(partition, &outcome)
    }

    fn seams(&mut self, partition: &Partition, submaps: &StageOutcome) -> Step<Submaps> {
        let mut result = Submaps { existing: Vec::new(), lost: Vec::new(), seams: Vec::new() };
        let mut place_of = vec![None; partition.clusters.len()];
        for (cluster, item) in partition.clusters.iter().zip(&submaps.items) {
            match item {
                Ok(key) => {
                    place_of[cluster.id.index()] = Some((result.existing.len() as u32, *key));
                    result.existing.push((cluster.id, *key));
                }
                Err(reason) => result.lost.push((cluster.id, reason.clone())),
            }
        }
        let mut items = Vec::new();
        let mut places = Vec::new();
        let mut waiting = 0;
        for seam in &partition.seams {
            let (Some((a, key_a)), Some((b, key_b))) = (place_of[seam.a.index()], place_of[seam.b.index()])
            else {
                continue;
            };
            if !self.known.exists(&key_a) || !self.known.exists(&key_b) {
                waiting += 1;
                continue;
            }
            let key = KeyBuilder::new(Stage::Align)
                .value(&self.config.align)?
                .number(self.config.seed)
                .inputs([&key_a, &key_b])
                .finish();
            let num_images = partition.clusters[seam.a.index()].images.len()
                + partition.clusters[seam.b.index()].images.len();
            places.push((a, b));
            items.push(Item {
                key,
                name: format!("clusters {} and {}", seam.a.0 + 1, seam.b.0 + 1),
                inputs: vec![key_a, key_b],
                cost: predict::submaps(num_images),
                spec: TaskSpec::Align { a: key_a, b: key_b },
            });
        }
        let outcome = self.many(Stage::Align, items);
        if let Some(align) = self.progress.iter_mut().find(|progress| progress.stage == Stage::Align) {
            align.total = align.total.map(|total| total + waiting);
        }
        if !submaps.complete || !outcome.complete {
            return Ok(None);
        }
        for ((a, b), item) in places.into_iter().zip(outcome.items) {
            if let Ok(key) = item {
                result.seams.push((a, b, key));
            }
        }
        Ok(Some(result))
    }

    pub(super) fn average(
        &mut self,
        table: &TableArtefact,
        run: &FinishedRun,
        seams: &[(u32, u32, ArtefactKey)],
    ) -> Step<ArtefactKey> {
        let submaps: Vec<ArtefactKey> = run.submaps.iter().map(|(_, key)| *key).collect();
        let key = KeyBuilder::new(Stage::Average)
            .value(&self.config.place)?
            .value(&self.config.camera_average)?
            .number(self.config.seed)
            .bytes(&table.digest)
            .inputs(&submaps)
            .value(seams)?
            .finish();
        let mut inputs = vec![run.table];
        inputs.extend(&submaps);
        inputs.extend(seams.iter().map(|(_, _, key)| *key));
        let item = Item {
            key,
            name: format!("{} clusters, {} seams", submaps.len(), seams.len()),
            inputs,
            cost: predict::submaps(table.table.images.len()),
            spec: TaskSpec::Average { table: run.table, submaps, seams: seams.to_vec() },
        };
        Ok(self.single(Stage::Average, item))
    }

    /// Merge, adjust and geo-register every component.
    pub(super) fn components(
        &mut self,
        table: &TableArtefact,
        run: &FinishedRun,
        average: ArtefactKey,
    ) -> Step<Vec<FinishedComponent>> {
        let store = self.store;
        let sizes = self.known.remember(average, "components", || read::component_sizes(store, &average))?;
        let submaps: Vec<ArtefactKey> = run.submaps.iter().map(|(_, key)| *key).collect();
        let mut items = Vec::new();
        for (component, num_images) in sizes.iter().enumerate() {
            let component = component as u32;
            let key = KeyBuilder::new(Stage::Merge)
                .value(&self.config.merge)?
                .input(&average)
                .number(u64::from(component))
                .finish();
            let mut inputs = vec![average];
            inputs.extend(&submaps);
            items.push(Item {
                key,
                name: component_name(component, sizes.len(), *num_images),
                inputs,
                cost: predict::submaps(*num_images as usize),
                spec: TaskSpec::Merge { average, submaps: submaps.clone(), component },
            });
        }
        let Some(merged) = self.all_components(Stage::Merge, items) else { return Ok(None) };
        let mut items = Vec::new();
        for (component, merge) in merged.iter().enumerate() {
            let num_images = sizes[component];
            let component = component as u32;
            let key = KeyBuilder::new(Stage::Adjust)
                .value(&self.config.adjust)?
                .bytes(&table.digest)
                .input(merge)
                .finish();
            items.push(Item {
                key,
                name: component_name(component, sizes.len(), num_images),
                inputs: vec![run.table, average, *merge],
                cost: predict::adjust(num_images as usize),
                spec: TaskSpec::Adjust { table: run.table, average, merge: *merge, component },
            });
        }
        let Some(adjusted) = self.all_components(Stage::Adjust, items) else { return Ok(None) };
        let Some(registered) = self.georegister(table, run, &sizes, &adjusted)? else { return Ok(None) };
        let components = merged.into_iter().zip(adjusted).zip(registered);
        Ok(Some(
            components
                .map(|((merge, adjust), georegister)| FinishedComponent { merge, adjust, georegister })
                .collect(),
        ))
    }

    fn georegister(
        &mut self,
        table: &TableArtefact,
        run: &FinishedRun,
        sizes: &[u64],
        adjusted: &[ArtefactKey],
    ) -> Step<Vec<ArtefactKey>> {
        let mut items = Vec::new();
        for (component, adjust) in adjusted.iter().enumerate() {
            let num_images = sizes[component];
            let component = component as u32;
            let key = KeyBuilder::new(Stage::Georegister)
                .value(&self.config.georegister)?
                .number(self.config.seed)
                .bytes(&table.digest)
                .input(adjust)
                .finish();
            items.push(Item {
                key,
                name: component_name(component, sizes.len(), num_images),
                inputs: vec![run.table, *adjust],
                cost: predict::submaps(num_images as usize),
                spec: TaskSpec::Georegister { table: run.table, adjust: *adjust, component },
            });
        }
        Ok(self.all_components(Stage::Georegister, items))
    }

    /// The artefacts of a stage that has one task a component, once all are there. A component that failed for good ends
    /// the run with its reason: the result would silently lack it.
    fn all_components(&mut self, stage: Stage, items: Vec<Item>) -> Option<Vec<ArtefactKey>> {
        let outcome = self.many(stage, items);
        if let Some(Err(reason)) = outcome.items.iter().find(|item| item.is_err()) {
            self.failed = Some(format!("{stage} failed: {reason}"));
            return None;
        }
        outcome.complete.then(|| outcome.existing())
    }

    pub(super) fn export(&mut self, run: FinishedRun) -> Step<()> {
        let key = KeyBuilder::new(Stage::Export).value(&run)?.finish();
        let mut inputs = vec![run.table, run.pairs, run.view_graph, run.partition];
        inputs.extend(run.components.iter().map(|component| component.georegister));
        let item = Item {
            key,
            name: "figures".to_owned(),
            inputs,
            cost: predict::submaps(1),
            spec: TaskSpec::Export { run: Box::new(run.clone()) },
        };
        if let Some(key) = self.single(Stage::Export, item) {
            self.finished = Some((key, run));
        }
        Ok(Some(()))
    }
}

fn component_name(component: u32, of: usize, num_images: u64) -> String {
    format!("component {} of {of}: {num_images} images", component + 1)
}

/// Which blocks hold pairs of each cluster, ascending.
fn blocks_of_clusters(partition: &Partition, num_images: usize, blocks: &[Vec<ImagePair>]) -> Vec<Vec<u32>> {
    let mut clusters_of: Vec<Vec<u32>> = vec![Vec::new(); num_images];
    for cluster in &partition.clusters {
        for image in &cluster.images {
            clusters_of[image.index()].push(cluster.id.0);
        }
    }
    let mut blocks_of: Vec<Vec<u32>> = vec![Vec::new(); partition.clusters.len()];
    for (block, pairs) in blocks.iter().enumerate() {
        for pair in pairs {
            for cluster in &clusters_of[pair.first().index()] {
                let list = &mut blocks_of[*cluster as usize];
                if list.last() != Some(&(block as u32))
                    && clusters_of[pair.second().index()].contains(cluster)
                {
                    list.push(block as u32);
                }
            }
        }
    }
    blocks_of
}
