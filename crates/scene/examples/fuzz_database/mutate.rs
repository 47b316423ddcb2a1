//! Damage to databases: to bytes of the file, and to values of rows. The same seed does the same damage.

use std::path::Path;

use super::terrane_scene_under_test::SceneError;
use super::terrane_scene_under_test::colmap::database::Database;
use rusqlite::Connection;

/// Numbers that follow from a seed (SplitMix64, Steele et al. 2014).
struct Draws(u64);

impl Draws {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, limit: usize) -> usize {
        (self.next() % limit.max(1) as u64) as usize
    }
}

/// Page size of shrunk files: many pages in few bytes.
const PAGE: usize = 512;

/// Rewrites a database in the smallest pages.
pub fn shrink(path: &Path) {
    let connection = Connection::open(path).expect("the sample opens");
    connection
        .execute_batch(&format!("PRAGMA page_size = {PAGE}; VACUUM;"))
        .expect("the sample is rewritten");
}

/// A copy of a file with up to eight changes, three in four of them where pages describe themselves.
pub fn bytes(whole: &[u8], seed: u64) -> Vec<u8> {
    let mut draws = Draws(seed);
    let mut bytes = whole.to_vec();
    for _ in 0..1 + draws.below(8) {
        let at = match draws.below(4) {
            0 => draws.below(bytes.len()),
            // The header of a page and the places of its cells; in the first page behind the file's own header.
            _ => (draws.below(bytes.len() / PAGE) * PAGE + draws.below(120)).min(bytes.len() - 1),
        };
        match draws.below(6) {
            0 => bytes[at] ^= 1 << draws.below(8),
            1 => bytes[at] = [0, 0xff, 0x7f, 0x80, 1][draws.below(5)],
            2 => bytes[at] = draws.next() as u8,
            3 => {
                let len = (1 + draws.below(64)).min(bytes.len() - at);
                bytes[at..at + len].iter_mut().for_each(|byte| *byte = draws.next() as u8);
            }
            4 => {
                let (from, len) = (draws.below(bytes.len()), 1 + draws.below(PAGE));
                let len = len.min(bytes.len() - from).min(bytes.len() - at);
                bytes.copy_within(from..from + len, at);
            }
            _ => bytes.truncate((bytes.len() - draws.below(PAGE)).max(PAGE)),
        }
    }
    bytes
}

const COLUMNS: &[(&str, &[&str])] = &[
    ("cameras", &["camera_id", "model", "width", "height", "params", "prior_focal_length"]),
    ("images", &["image_id", "name", "camera_id"]),
    ("keypoints", &["image_id", "rows", "cols", "data"]),
    ("descriptors", &["image_id", "type", "rows", "cols", "data"]),
    ("matches", &["pair_id", "rows", "cols", "data"]),
    ("two_view_geometries", &["pair_id", "rows", "cols", "data"]),
];

/// Puts up to three values into rows where they do not belong.
pub fn values(path: &Path, seed: u64) {
    let mut draws = Draws(seed);
    let connection = Connection::open(path).expect("the sample opens");
    connection
        .execute_batch("PRAGMA foreign_keys = OFF; PRAGMA journal_mode = OFF;")
        .expect("the sample opens");
    for _ in 0..1 + draws.below(3) {
        let (table, columns) = COLUMNS[draws.below(COLUMNS.len())];
        let column = columns[draws.below(columns.len())];
        let value = match draws.below(9) {
            0 => "NULL".to_owned(),
            1 => format!("{}", draws.next() as i64),
            2 => format!("{}", draws.below(10)),
            3 => "-1".to_owned(),
            4 => "'text'".to_owned(),
            5 => "1e300".to_owned(),
            6 => format!("zeroblob({})", draws.below(2000)),
            7 => format!("x'{:016x}'", draws.next()),
            _ => format!("{}", (1 + draws.below(6) as i64) * 2_147_483_647 + draws.below(6) as i64),
        };
        let row = draws.below(3);
        let sql = format!(
            "UPDATE OR IGNORE {table} SET {column} = {value} WHERE rowid = (SELECT rowid FROM {table} LIMIT 1 OFFSET {row})"
        );
        // Some values the table itself refuses.
        let _ = connection.execute_batch(&sql);
    }
}

/// Reads everything there is, as an import does.
pub fn read_all(path: &Path) -> Result<u64, SceneError> {
    let database = Database::open(path)?;
    let mut read = database.cameras()?.len() as u64;
    for image in database.images()? {
        read += database.keypoints(image.id)?.map_or(0, |keypoints| keypoints.len() as u64);
        read += database.descriptors(image.id)?.len() as u64;
    }
    for pair in database.pairs()? {
        read += database.matches(pair.first, pair.second)?.len() as u64;
    }
    Ok(read)
}
