//! Models, points and camera positions of a finished run.

use std::borrow::Cow;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use terrane_geometry::Camera;
use terrane_geometry::geodesy::{EnuFrame, Geodetic};
use terrane_scene::colmap::{ModelFiles, write_binary};
use terrane_scene::positions::{CameraPosition, write_geojson};
use terrane_scene::{CameraId, ImageId, ImageTable, Model, Reconstruction, RegisteredImage, SceneError, ply};

use crate::execute::RunReport;
use crate::execute::read::{self, Sharded};
use crate::task::FinishedRun;
use crate::{PipelineError, Store};

/// A final component, its shards still in the store.
struct StoredModel<'a> {
    cameras: Reconstruction,
    sharded: Sharded<'a>,
}

impl Model for StoredModel<'_> {
    fn cameras(&self) -> &[(CameraId, Camera)] {
        &self.cameras.cameras
    }

    fn images(&self) -> &[RegisteredImage] {
        &self.cameras.images
    }

    fn num_shards(&self) -> usize {
        self.sharded.num_shards()
    }

    fn shard(&self, shard: usize) -> Result<Cow<'_, Reconstruction>, SceneError> {
        self.sharded.shard(shard).map(Cow::Owned).map_err(SceneError::from_source)
    }
}

/// All components one after another, for files that hold points only.
struct AllPoints<'a>(&'a [StoredModel<'a>]);

impl Model for AllPoints<'_> {
    fn cameras(&self) -> &[(CameraId, Camera)] {
        &[]
    }

    fn images(&self) -> &[RegisteredImage] {
        &[]
    }

    fn num_shards(&self) -> usize {
        self.0.iter().map(|model| model.num_shards()).sum()
    }

    fn shard(&self, mut shard: usize) -> Result<Cow<'_, Reconstruction>, SceneError> {
        for model in self.0 {
            if shard < model.num_shards() {
                return model.shard(shard);
            }
            shard -= model.num_shards();
        }
        Ok(Cow::Owned(Reconstruction::default()))
    }
}

/// Writes `sparse/`, `points.ply` and `cameras.geojson` into a folder. Components in frames of their own, beyond the
/// geo-referenced ones, have models but no points in `points.ply`: they would lie in the wrong place.
pub(super) fn write(
    store: &Store,
    run: &FinishedRun,
    report: &RunReport,
    folder: &Path,
) -> Result<(), PipelineError> {
    let table = read::table(store, &run.table)?.table;
    let name_of =
        |image: ImageId| table.images.get(image.index()).map_or(String::new(), |found| found.path.clone());
    let mut models = Vec::new();
    for component in &run.components {
        let sharded = Sharded::open(store, &component.georegister)?;
        models.push(StoredModel { cameras: sharded.cameras()?, sharded });
    }
    make_folder(&folder.join("sparse"))?;
    for (place, model) in models.iter().enumerate() {
        let sub = folder.join("sparse").join(place.to_string());
        make_folder(&sub)?;
        let file = |name: &str| create(&sub.join(name));
        let files = ModelFiles {
            cameras: file("cameras.bin")?,
            images: file("images.bin")?,
            points: file("points3D.bin")?,
        };
        write_binary(model, &name_of, files).map_err(|error| file_error(&sub, error))?;
    }
    let main_is_geo = report.components.first().is_some_and(|component| component.georeferenced);
    let shown: Vec<StoredModel<'_>> = models
        .into_iter()
        .zip(&report.components)
        .enumerate()
        .filter(|(place, (_, component))| *place == 0 || (component.georeferenced && main_is_geo))
        .map(|(_, (model, _))| model)
        .collect();
    let path = folder.join("points.ply");
    ply::write(&AllPoints(&shown), &frame_comment(report), create(&path)?)
        .map_err(|error| file_error(&path, error))?;
    write_positions(store, run, report, &table, folder)
}

fn frame_comment(report: &RunReport) -> String {
    match &report.frame.origin {
        Some(origin) => format!(
            "metres east, north, up of latitude {} longitude {} height {} ({})",
            origin.latitude_deg, origin.longitude_deg, origin.height_m, report.frame.height_datum
        ),
        None => "arbitrary frame and scale".to_owned(),
    }
}

fn write_positions(
    store: &Store,
    run: &FinishedRun,
    report: &RunReport,
    table: &ImageTable,
    folder: &Path,
) -> Result<(), PipelineError> {
    let frame = report.frame.origin.as_ref().map(|origin| {
        EnuFrame::new(Geodetic {
            latitude_rad: origin.latitude_deg.to_radians(),
            longitude_rad: origin.longitude_deg.to_radians(),
            height_m: origin.height_m,
        })
    });
    let mut positions = Vec::new();
    for (place, component) in run.components.iter().enumerate() {
        let entry = report.components.get(place);
        let frame = frame.as_ref().filter(|_| entry.is_some_and(|entry| entry.georeferenced));
        let residuals = entry.and_then(|entry| entry.gps.as_ref()).map_or(&[][..], |gps| &gps.residuals);
        for image in Sharded::open(store, &component.georegister)?.cameras()?.images {
            let path = table.images.get(image.image.index()).map_or("", |found| found.path.as_str());
            let center = image.cam_from_world.center();
            // Residuals ascend by image, so by path.
            let residual = residuals.binary_search_by(|residual| residual.path.as_str().cmp(path)).ok();
            positions.push(CameraPosition {
                name: path.to_owned(),
                component: place as u32,
                x_in_world: center.into(),
                lon_lat_height: frame.map(|frame| {
                    let at = frame.geodetic_from_enu(&center);
                    [at.longitude_rad.to_degrees(), at.latitude_rad.to_degrees(), at.height_m]
                }),
                gps_residual_m: residual.map(|at| residuals[at].residual_m),
            });
        }
    }
    let path = folder.join("cameras.geojson");
    write_geojson(&positions, &report.frame.height_datum, create(&path)?)
        .map_err(|error| file_error(&path, error))
}

fn make_folder(path: &Path) -> Result<(), PipelineError> {
    std::fs::create_dir_all(path)
        .map_err(|error| PipelineError::io(&format!("folder {} can't be made", path.display()), &error))
}

pub(super) fn create(path: &Path) -> Result<BufWriter<File>, PipelineError> {
    File::create(path)
        .map(BufWriter::new)
        .map_err(|error| PipelineError::io(&format!("{} can't be written", path.display()), &error))
}

/// An exporter's error: the store's own, the disk's, or what the model lacks.
fn file_error(path: &Path, error: SceneError) -> PipelineError {
    let what = format!("{} can't be written", path.display());
    match error.into_source() {
        Ok(source) => match source.downcast::<PipelineError>() {
            Ok(ours) => *ours,
            Err(other) => match other.downcast::<std::io::Error>() {
                Ok(io) => PipelineError::io(&what, &io),
                Err(other) => PipelineError::storage(format!("{what}: {other}")),
            },
        },
        Err(error) => PipelineError::bug(format!("{what}: {error}")),
    }
}

/// Writes text and makes sure that it has left the process.
pub(super) fn write_text(path: &Path, text: &str) -> Result<(), PipelineError> {
    let failed =
        |error: std::io::Error| PipelineError::io(&format!("{} can't be written", path.display()), &error);
    let mut file = create(path)?;
    file.write_all(text.as_bytes()).and_then(|()| file.flush()).map_err(failed)
}
