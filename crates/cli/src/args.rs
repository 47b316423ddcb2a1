//! Flags as typed. Nothing here looks at the machine, at files or at the environment, so that help is always the same.

use std::net::SocketAddr;
use std::num::NonZeroU32;
use std::path::PathBuf;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, Subcommand, ValueEnum};
use terrane_pipeline::adjustment::{BundleSolver, Loss, Precision, Preconditioner};
use terrane_pipeline::calibrate::Target;
use terrane_pipeline::{CameraOverride, FeatureMethod, Matcher};

/// Photographs in, one geo-referenced sparse reconstruction out.
#[derive(Debug, Parser)]
#[command(
    name = "terrane",
    version,
    max_term_width = 110,
    after_help = "Exit codes: 0 done; 1 it ran and the result falls short of what was asked; 2 usage or input is no good;\n\
                  3 storage or cluster failed; 130 interrupted (the same command resumes)."
)]
pub struct Arguments {
    /// Print machine-readable lines of JSON instead of text.
    #[arg(long, global = true)]
    pub json: bool,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Reconstruct on this machine: a coordinator and worker processes.
    Run(RunFlags),
    /// Render a small town with known truth, reconstruct it, and print how far off the result is.
    Demo(DemoFlags),
    /// Serve as a coordinator, to which workers and clients come.
    Coordinator(CoordinatorFlags),
    /// Work for a coordinator.
    Worker(WorkerFlags),
    /// Hand a run to a coordinator.
    Submit(SubmitFlags),
    /// How the runs and workers of a coordinator stand.
    Status(RemoteFlags),
    /// End a run at a coordinator; what it has computed is kept.
    Cancel(CancelFlags),
    /// Print the log of a coordinator.
    Logs(RemoteFlags),
    /// Write a finished result in another format.
    Export(ExportFlags),
    /// Show what a finished result holds.
    Inspect(InspectFlags),
    /// Compare two results: differences of cameras after a robust similarity.
    Compare(CompareFlags),
    /// Adjust a whole problem: a BAL file or a COLMAP model, in this process or on worker processes.
    Adjust(AdjustFlags),
    /// A camera's intrinsics from photographs of a checkerboard or an AprilGrid.
    Calibrate(CalibrateFlags),
    /// Hold parts of an adjustment for `adjust`, which starts this itself.
    #[command(hide = true)]
    Hold(HoldFlags),
    /// Print the options of a run with their values.
    Config(ConfigFlags),
}

/// What decides a result, shared by `run`, `submit` and `config`.
#[derive(Clone, Debug, Default, Args)]
pub struct OptionFlags {
    /// Most photographs of a cluster, those that it shares with neighbours included.
    #[arg(long, value_name = "N")]
    pub cluster_size: Option<u32>,
    /// Trusted intrinsics of all photographs, as COLMAP writes them: MODEL:p1,p2,…
    #[arg(long, value_name = "MODEL:PARAMS")]
    pub camera: Option<CameraOverride>,
    /// Which features are found and matched [default: sift].
    #[arg(long, value_name = "NAME", value_parser = feature_methods())]
    pub features: Option<FeatureMethod>,
    /// Match only the pairs of a text file, two paths a line, as COLMAP's lists of pairs.
    #[arg(long, value_name = "FILE")]
    pub pairs: Option<PathBuf>,
    /// Words for retrieval instead of words learnt from the run: a file of descriptors, 128 bytes each.
    #[arg(long, value_name = "FILE")]
    pub vocabulary: Option<PathBuf>,
    /// How nearest features are found: exact and cascade give the same answer, ann misses one match in a hundred and is
    /// several times faster [default: ann].
    #[arg(long, value_name = "NAME", value_parser = matchers())]
    pub matcher: Option<Matcher>,
    /// Folder of masks, black where features must keep out (moving things, sky, water). The mask of a/b.jpg is a/b.jpg.png,
    /// as COLMAP names it, or a/b.png or b.png where that can be of no other photograph; others are used whole.
    #[arg(long, value_name = "FOLDER")]
    pub masks: Option<PathBuf>,
    /// Take cameras, features and matches from a COLMAP database instead of computing them: learned features, for instance.
    /// Its images are the run's; photographs then give colours, positions and times only, and may be absent.
    #[arg(long, value_name = "DATABASE", conflicts_with = "masks")]
    pub import: Option<PathBuf>,
    /// Seed of every random choice [default: 0].
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Options from a JSON file, as `terrane config --dump` prints them; those left out keep their defaults.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// One option by its path, as mapping.max_error_px=4; may be given several times, and wins over the file.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

/// Matchers by their names, which help and refusals list.
fn matchers() -> impl TypedValueParser<Value = Matcher> {
    PossibleValuesParser::new(Matcher::ALL.map(Matcher::name)).try_map(|name| name.parse::<Matcher>())
}

/// Flags of `run`.
#[derive(Debug, Args)]
pub struct RunFlags {
    /// Folder of photographs (searched recursively), or a text file that lists them, one path a line.
    pub photos: PathBuf,
    /// Folder of the result; made if absent. Intermediate artefacts are kept in its .terrane.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: PathBuf,
    /// Worker processes [default: one for each core, at most 4].
    #[arg(long, value_name = "N")]
    pub workers: Option<NonZeroU32>,
    /// Threads of each worker [default: one for each core, for when other workers idle].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroU32>,
    /// Memory that each worker may use, as 2GiB [default: three quarters of the machine's, divided by workers].
    #[arg(long, value_name = "SIZE", value_parser = parse_size)]
    pub memory: Option<u64>,
    /// Port on which workers reach the coordinator [default: any free one].
    #[arg(long, value_name = "PORT", default_value_t = 0, hide_default_value = true)]
    pub port: u16,
    /// What decides the result.
    #[command(flatten)]
    pub options: OptionFlags,
}

/// Flags of `demo`.
#[derive(Debug, Args)]
pub struct DemoFlags {
    /// Folder of the photographs, the truth and the result.
    #[arg(short, long, value_name = "FOLDER", default_value = "terrane-demo")]
    pub out: PathBuf,
}

/// Flags of `coordinator`.
#[derive(Debug, Args)]
pub struct CoordinatorFlags {
    /// Address to listen on.
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:7070")]
    pub listen: SocketAddr,
    /// Allow an address that other machines reach: everything travels in the clear, tokens included.
    #[arg(long)]
    pub allow_plaintext: bool,
}

/// Where a coordinator is.
#[derive(Clone, Debug, Args)]
pub struct RemoteFlags {
    /// The coordinator. Its token, if it wants one, is taken from the environment variable TERRANE_TOKEN.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7070")]
    pub coordinator: String,
}

/// Flags of `worker`.
#[derive(Debug, Args)]
pub struct WorkerFlags {
    /// Where the coordinator is.
    #[command(flatten)]
    pub remote: RemoteFlags,
    /// Name of this worker, unique at its coordinator [default: host and process].
    #[arg(long)]
    pub name: Option<String>,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroU32>,
    /// Memory that it may use, as 2GiB [default: three quarters of the machine's].
    #[arg(long, value_name = "SIZE", value_parser = parse_size)]
    pub memory: Option<u64>,
    /// Seconds that the coordinator may be out of reach before the worker gives up.
    #[arg(long, value_name = "SECONDS", default_value_t = 60)]
    pub patience: u64,
    /// End with this process, which started the worker.
    #[arg(long, value_name = "PID", hide = true)]
    pub parent: Option<u32>,
}

/// Flags of `submit`.
#[derive(Debug, Args)]
pub struct SubmitFlags {
    /// Folder of photographs, or a text file that lists them; coordinator and workers see it under the same path.
    pub photos: PathBuf,
    /// Folder of the result, likewise.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: PathBuf,
    /// Where the coordinator is.
    #[command(flatten)]
    pub remote: RemoteFlags,
    /// Don't wait for the end of the run.
    #[arg(long)]
    pub detach: bool,
    /// What decides the result.
    #[command(flatten)]
    pub options: OptionFlags,
}

/// Flags of `cancel`.
#[derive(Debug, Args)]
pub struct CancelFlags {
    /// Number of the run, as `submit` and `status` print it.
    pub run: u64,
    /// Where the coordinator is.
    #[command(flatten)]
    pub remote: RemoteFlags,
}

/// A format of `export`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// COLMAP's text files: cameras.txt, images.txt, points3D.txt.
    ColmapTxt,
    /// The points with their colours.
    Ply,
    /// Camera positions for maps.
    Geojson,
    /// Camera positions for globes.
    Kml,
    /// A COLMAP database with the run's cameras, features, matches and two-view geometries, for its mappers.
    ColmapDb,
}

/// Flags of `export`.
#[derive(Debug, Args)]
pub struct ExportFlags {
    /// Folder of a finished result.
    pub out: PathBuf,
    /// What to write.
    #[arg(long)]
    pub format: Format,
    /// Where to write it [default: into the result's folder].
    #[arg(short = 'o', long, value_name = "PATH")]
    pub to: Option<PathBuf>,
    /// Which component, 0 being the largest.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub component: u32,
}

/// Flags of `inspect`.
#[derive(Debug, Args)]
pub struct InspectFlags {
    /// Folder of a result, or of a COLMAP model.
    pub out: PathBuf,
}

/// Flags of `compare`.
#[derive(Debug, Args)]
pub struct CompareFlags {
    /// Folder of a result, or of a COLMAP model.
    pub a: PathBuf,
    /// Another one.
    pub b: PathBuf,
}

/// Flags of `adjust`.
#[derive(Debug, Args)]
pub struct AdjustFlags {
    /// A "bundle adjustment in the large" text file, a COLMAP model's folder, or the folder of a finished run.
    pub problem: PathBuf,
    /// File (of a BAL problem) or folder (of a model) for the result.
    #[arg(short, long, value_name = "PATH")]
    pub out: PathBuf,
    /// Loss of reprojection errors: squared, huber, soft-l1, cauchy, geman-mcclure.
    #[arg(long, value_name = "NAME", default_value = "squared", value_parser = serde_name::<Loss>)]
    pub loss: Loss,
    /// Scale of the loss in pixels.
    #[arg(long, value_name = "PX", default_value_t = 1.0)]
    pub loss_scale_px: f64,
    /// What to refine of a model's cameras beside poses: any of focal, principal-point, distortion, or none. Those of a BAL
    /// problem are always its focal length, k1 and k2.
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "focal,distortion")]
    pub refine: Vec<String>,
    /// Most steps.
    #[arg(long, value_name = "N", default_value_t = 50)]
    pub max_iterations: u32,
    /// Stop when a step lowers the cost by less than this part.
    #[arg(long, value_name = "PART", default_value_t = 1e-6)]
    pub cost_tolerance: f64,
    /// First damping, relative to the diagonal of the normal equations.
    #[arg(long, value_name = "PART", default_value_t = 1e-4)]
    pub initial_damping: f64,
    /// How steps are solved for: auto, explicit (a factorised camera system), implicit (conjugate gradients).
    #[arg(long, value_name = "NAME", default_value = "auto", value_parser = serde_name::<BundleSolver>)]
    pub solver: BundleSolver,
    /// Preconditioner of conjugate gradients: auto, two-level, cluster-blocks, power-series, block-jacobi.
    #[arg(long, value_name = "NAME", default_value = "auto", value_parser = serde_name::<Preconditioner>)]
    pub preconditioner: Preconditioner,
    /// Conjugate gradients stop when the residual, in the preconditioner's norm, is below this part of the first.
    #[arg(long, value_name = "PART", default_value_t = 0.1)]
    pub linear_tolerance: f64,
    /// What products are computed in: single (sums in double), double.
    #[arg(long, value_name = "NAME", default_value = "single", value_parser = serde_name::<Precision>)]
    pub precision: Precision,
    /// Worker processes that hold the points; 0 solves in this process. The result is the same to the last bit.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub workers: u32,
    /// Threads of this process, or of each worker [default: all cores].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroU32>,
    /// Memory that points may take, here or in each worker, as 2GiB; more than fits is read again from disk for each
    /// product [default: no limit here, the machine's share for workers].
    #[arg(long, value_name = "SIZE", value_parser = parse_size)]
    pub memory: Option<u64>,
    /// Folder for parts of the problem while it is solved, which all workers can read [default: beside the result].
    #[arg(long, value_name = "FOLDER")]
    pub scratch: Option<PathBuf>,
}

/// Flags of `calibrate`.
#[derive(Debug, Args)]
pub struct CalibrateFlags {
    /// Photographs of the target by one camera, or folders of them.
    #[arg(required = true)]
    pub photos: Vec<PathBuf>,
    /// The target: checkerboard:COLUMNSxROWS[:SQUARE_M], of inner corners, or aprilgrid:COLUMNSxROWS[:TAG_M:SPACING].
    #[arg(long, value_name = "TARGET")]
    pub target: Target,
    /// Camera model, as COLMAP names it.
    #[arg(long, default_value = "OPENCV")]
    pub model: String,
    /// File for the camera, which --config of other commands reads.
    #[arg(short, long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// Flags of `hold`.
#[derive(Debug, Args)]
pub struct HoldFlags {
    /// Where the solver is.
    #[command(flatten)]
    pub remote: RemoteFlags,
    /// Folder with the parts.
    #[arg(long, value_name = "FOLDER")]
    pub scratch: PathBuf,
    /// Name of this holder.
    #[arg(long, default_value = "holder")]
    pub name: String,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroU32>,
    /// Memory that it may use.
    #[arg(long, value_name = "SIZE", value_parser = parse_size)]
    pub memory: Option<u64>,
    /// End with this process.
    #[arg(long, value_name = "PID", hide = true)]
    pub parent: Option<u32>,
}

/// A name as options are written in JSON, with dashes or underscores.
fn serde_name<T: serde::de::DeserializeOwned>(name: &str) -> Result<T, String> {
    serde_json::from_value(serde_json::Value::String(name.replace('-', "_")))
        .map_err(|error| error.to_string())
}

/// Flags of `config`.
#[derive(Debug, Args)]
pub struct ConfigFlags {
    /// Print all options as JSON, to be edited and given back with --config.
    #[arg(long, required = true)]
    pub dump: bool,
    /// What decides the result.
    #[command(flatten)]
    pub options: OptionFlags,
}

/// Features by their names, which help and refusals list.
fn feature_methods() -> impl TypedValueParser<Value = FeatureMethod> {
    PossibleValuesParser::new(FeatureMethod::ALL.map(FeatureMethod::name))
        .try_map(|name| name.parse::<FeatureMethod>())
}

/// Bytes from a size as people write it: a number with an optional unit, 1024-based for KiB to TiB and 1000-based for kB to TB.
pub fn parse_size(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let digits = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let scale: f64 = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kib" => 1024.0,
        "m" | "mib" => 1024.0 * 1024.0,
        "g" | "gib" => 1024.0 * 1024.0 * 1024.0,
        "t" | "tib" => 1024.0 * 1024.0 * 1024.0 * 1024.0,
        "kb" => 1e3,
        "mb" => 1e6,
        "gb" => 1e9,
        "tb" => 1e12,
        _ => return Err(format!("`{unit}` is no unit of memory: use MiB, GiB, MB or GB")),
    };
    let number: f64 = number.parse().map_err(|_| format!("`{text}` is no size: write it as 2GiB"))?;
    Ok((number * scale) as u64)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn unknown_features_are_refused_with_the_known_ones() {
        let refused = Arguments::try_parse_from(["terrane", "run", "p", "-o", "o", "--features", "bogus"]);
        let refused = refused.unwrap_err();
        assert_eq!(refused.exit_code(), 2);
        let message = refused.to_string();
        for name in
            ["bogus", "sift", "sift-upright", "sift-affine", "harris", "fast", "orb", "surf", "surf-upright"]
        {
            assert!(message.contains(name), "{name} is missing in: {message}");
        }
    }

    #[test]
    fn sizes_are_read_as_people_write_them() {
        for (text, bytes) in
            [("2GiB", 2 << 30), ("512MiB", 512 << 20), ("1.5G", 3 << 29), ("2GB", 2_000_000_000), ("77", 77)]
        {
            assert_eq!(parse_size(text), Ok(bytes), "{text}");
        }
        for text in ["", "GiB", "two", "-1GiB", "1 parsec", "1.2.3M"] {
            assert!(parse_size(text).is_err(), "{text}");
        }
    }

    #[test]
    fn the_commands_of_the_issue_are_understood() {
        let camera = "--camera PINHOLE:2759.48,2764.16,1520.69,1006.81";
        for line in [
            format!("terrane run p -o o {camera}"),
            "terrane run p -o o --workers 2 --cluster-size 50 --memory 2GiB --seed 3 --set mapping.x=1"
                .into(),
            "terrane run p -o o --matcher ann".into(),
            "terrane run p -o o --features orb".into(),
            "terrane submit p -o o --features surf-upright".into(),
            "terrane coordinator --listen 127.0.0.1:0".into(),
            "terrane worker --coordinator http://h:1".into(),
            "terrane run p -o o --masks m".into(),
            "terrane submit p -o o --import database.db".into(),
            "terrane export o --format colmap-txt".into(),
            "terrane export o --format colmap-db -o database.db".into(),
            "terrane --json status".into(),
            "terrane config --dump".into(),
        ] {
            assert!(Arguments::try_parse_from(line.split(' ')).is_ok(), "{line}");
        }
        for line in [
            "terrane run p",
            "terrane run p -o o --matcher bogus",
            "terrane run p -o o --workers 0",
            "terrane run p -o o --memory x",
            "terrane run p -o o --camera FISH:1",
            "terrane run p -o o --masks m --import database.db",
        ] {
            assert_eq!(Arguments::try_parse_from(line.split(' ')).unwrap_err().exit_code(), 2, "{line}");
        }
    }
}
