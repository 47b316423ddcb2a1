//! Rust from `proto/`, without `protoc`: protox parses, tonic-prost-build writes, the result is committed.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

const HEADER: &str =
    "//! Generated from proto/terrane/v1 by `cargo run -p terrane-xtask -- generate`: do not edit.\n";
const PROTOS: [&str; 2] = ["terrane/v1/coordinator.proto", "terrane/v1/adjuster.proto"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn committed() -> PathBuf {
    root().join("crates/proto/src/generated/v1.rs")
}

/// The code that `proto/` gives now.
fn render() -> anyhow::Result<String> {
    let files = protox::Compiler::new([root().join("proto")])?
        .include_source_info(true)
        .include_imports(true)
        .open_files(PROTOS)?
        .file_descriptor_set();
    let out = tempfile::tempdir().context("a temporary folder")?;
    tonic_prost_build::configure().bytes(".").out_dir(out.path()).compile_fds(files)?;
    let code = std::fs::read_to_string(out.path().join("terrane.v1.rs")).context("the generated file")?;
    Ok(format!("{HEADER}{code}"))
}

/// Writes the generated code to its committed place.
pub fn write() -> anyhow::Result<()> {
    let path = committed();
    let code = render()?;
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    std::fs::write(&path, code).with_context(|| format!("{}", path.display()))
}

/// Fails when the committed code is not what `proto/` gives.
pub fn check() -> anyhow::Result<()> {
    let path = committed();
    let found = std::fs::read_to_string(&path).with_context(|| format!("{}", path.display()))?;
    if found != render()? {
        bail!(
            "{} is stale: run `cargo run -p terrane-xtask -- generate` and commit the result",
            path.display()
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #[test]
    fn generated_code_is_fresh() {
        super::check().unwrap();
    }
}
