//! The sets of photographs, and their features and pairs as terrane sees them.

use std::path::PathBuf;

use anyhow::Context;
use rayon::prelude::*;
use terrane_benches::data;
use terrane_frontend::cameras::{self, GivenCamera};
use terrane_frontend::image::{self, DecodeOptions, DecodedImage};
use terrane_frontend::metadata;
use terrane_scene::CameraRecord;

/// A set of photographs.
pub struct Set {
    /// Its name in tables.
    pub name: &'static str,
    /// Where it lies among the data.
    pub folder: &'static str,
    /// Intrinsics that are known, as flags give them.
    pub camera: Option<&'static str>,
    /// Neighbours by GPS that COLMAP pairs; all with all when `None`.
    pub spatial: Option<u32>,
    /// Whether it belongs to a quick run.
    pub quick: bool,
}

/// All five, from small to large.
pub const SETS: &[Set] = &[
    Set {
        name: "fountain-P11",
        folder: "strecha/fountain-P11/images",
        camera: None,
        spatial: None,
        quick: true,
    },
    Set {
        name: "castle-P19",
        folder: "strecha/castle-P19/images",
        camera: Some("PINHOLE:2759.48,2764.16,1520.69,1006.81"),
        spatial: None,
        quick: false,
    },
    Set { name: "sceaux-castle", folder: "sceaux-castle/images", camera: None, spatial: None, quick: false },
    Set { name: "brighton-half", folder: "brighton-half/images", camera: None, spatial: None, quick: true },
    Set { name: "seneca-half", folder: "seneca-half/images", camera: None, spatial: Some(30), quick: false },
];

/// A photograph with the camera that took it.
pub struct Photograph {
    /// Name relative to the set's folder.
    pub name: String,
    /// The file.
    pub bytes: Vec<u8>,
    /// Intrinsics to start from.
    pub camera: CameraRecord,
}

impl Set {
    /// The folder of the photographs.
    pub fn path(&self) -> PathBuf {
        data().join(self.folder)
    }

    /// The set of a name.
    pub fn named(name: &str) -> &'static Set {
        SETS.iter().find(|set| set.name == name).unwrap_or(&SETS[0])
    }

    /// Every usable photograph, sorted by name; at most `limit`.
    ///
    /// # Errors
    /// When the folder or a file can't be read.
    pub fn photographs(&self, limit: usize) -> anyhow::Result<Vec<Photograph>> {
        let folder = self.path();
        let entries =
            std::fs::read_dir(&folder).with_context(|| format!("{} is missing", folder.display()))?;
        let mut names: Vec<String> =
            entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        let mut described = Vec::new();
        let mut files = Vec::new();
        for name in names {
            let bytes = std::fs::read(folder.join(&name))?;
            if let Ok(metadata) = metadata::read(&bytes) {
                described.push((name, metadata));
                files.push(bytes);
            }
            if files.len() == limit {
                break;
            }
        }
        let given: Option<GivenCamera> = self.camera.map(str::parse).transpose()?;
        let (records, camera_of) = cameras::group(&described, given.as_ref());
        let photographs = described.into_iter().zip(files).zip(camera_of);
        Ok(photographs
            .map(|(((name, _), bytes), camera)| Photograph {
                name,
                bytes,
                camera: records[camera.index()].clone(),
            })
            .collect())
    }
}

/// Decodes photographs on all cores.
///
/// # Errors
/// When a file can't be decoded.
pub fn decoded(photographs: &[Photograph]) -> anyhow::Result<Vec<DecodedImage>> {
    photographs
        .par_iter()
        .map(|photograph| Ok(image::decode(&photograph.bytes, &DecodeOptions::default())?))
        .collect()
}
