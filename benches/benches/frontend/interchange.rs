//! COLMAP's own mappers on terrane's database and on their own, judged by surveyed poses.

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use terrane_benches::table::{Bar, Row};
use terrane_benches::{Request, data, peer as peers, process, root};

use crate::peer;
use crate::sets::Set;

pub fn rows(request: &Request) -> anyhow::Result<Vec<Row>> {
    let Some(python) = process::python() else {
        let row = Row::new("COLMAP's mappers on terrane's database", None, "", Bar::None);
        return Ok(vec![row.note("no Python with pycolmap")]);
    };
    let terrane = process::full_terrane()?;
    let mut rows = Vec::new();
    for name in ["fountain-P11", "castle-P19"] {
        let set = Set::named(name);
        if !request.wants_set(set.name, set.quick) {
            continue;
        }
        let folder = tempfile::tempdir()?;
        let (out, database) = (folder.path().join("out"), folder.path().join("terrane.db"));
        let mut run = Command::new(&terrane);
        run.arg("run").arg(set.path()).arg("-o").arg(&out);
        process::run(run.args(set.camera.iter().flat_map(|camera| ["--camera", camera])))?;
        let mut export = Command::new(&terrane);
        process::run(export.args(["export", "--format", "colmap-db", "-o"]).arg(&database).arg(&out))?;
        let ours = mapped(&python, set, &database, &folder.path().join("ours"))?;
        let theirs = match peer::frontend(set, &[]) {
            Some(_) => {
                let database = peer::work(set, &[]).join("database.db");
                mapped(&python, set, &database, &folder.path().join("theirs"))?
            }
            None => Vec::new(),
        };
        rows.extend(compared(set, &ours, &theirs));
    }
    Ok(rows)
}

/// What each mapper makes of a database, a JSON object a mapper.
fn mapped(python: &Path, set: &Set, database: &Path, work: &Path) -> anyhow::Result<Vec<Value>> {
    let truth = data().join(set.folder).join("../gt_dense_cameras");
    let mut command = Command::new(python);
    command.arg(root().join("benches/peers/colmap_map.py")).arg(database).arg(set.path()).arg(work);
    command.arg("--evaluate").arg(peers().join("evaluate.py"));
    command.arg("--truth").arg(format!("gt-strecha={}", truth.display()));
    let (_, text) = process::run(&mut command)?;
    let lines = text.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    Ok(lines.filter(|line| line.get("mapper").is_some()).collect())
}

fn compared(set: &Set, ours: &[Value], theirs: &[Value]) -> Vec<Row> {
    let mut rows = Vec::new();
    for model in ours {
        let mapper = model["mapper"].as_str().unwrap_or_default();
        let other = theirs.iter().find(|other| other["mapper"] == model["mapper"]);
        let figure = |what: &str| format!("{}, COLMAP's {mapper} mapper: {what}", set.name);
        for (key, what, unit) in [("auc@1", "AUC@1", ""), ("centre_rmse", "centre RMSE", "m")] {
            let (got, their) = (model[key].as_f64(), other.and_then(|other| other[key].as_f64()));
            rows.push(Row::new(figure(&format!("{what}, terrane's features")), got, unit, Bar::None));
            rows.push(Row::new(figure(&format!("{what}, its own")), their, unit, Bar::None));
        }
    }
    rows
}
