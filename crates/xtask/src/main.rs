//! Chores of the workspace: `cargo run -p terrane-xtask -- generate` writes the protobuf code anew.

mod generate;

use anyhow::bail;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        ["generate"] => generate::write(),
        ["generate", "--check"] => generate::check(),
        _ => bail!("usage: xtask generate [--check]"),
    }
}
