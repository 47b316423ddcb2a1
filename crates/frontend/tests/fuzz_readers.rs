//! Damaged files of every kind: no panic, no allocation beyond what the file's length and size allow. The long run is
//! `cargo bench -p terrane-benches --bench fuzz_readers`.

use terrane_frontend::{image, metadata};
use terrane_testkit::allocation::{Counting, peak_bytes};
use terrane_testkit::files;
use terrane_testkit::mutate::{Mutator, Specimen};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// What reading a small damaged file may take: an honest one takes some ten kilobytes, and one that claims to be packed
/// as tightly as its format can be takes a few megabytes.
const MAX_BYTES: u64 = 32 << 20;
const OPTIONS: image::DecodeOptions = image::DecodeOptions { max_pixels: 1_000_000, color: true };

fn hunt(specimens: &[Specimen], executions: u64, read: impl Fn(&[u8])) {
    let mutator = Mutator::new(specimens, files::words(), 4096);
    for seed in 0..executions {
        let (index, mut bytes) = mutator.variant(seed);
        if !seed.is_multiple_of(4) && bytes.starts_with(b"\x89PNG") {
            files::mend_png(&mut bytes);
        }
        let (outcome, peak) =
            peak_bytes(|| std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| read(&bytes))));
        let name = &specimens[index].name;
        assert!(outcome.is_ok(), "seed {seed} of {name} panics");
        assert!(peak < MAX_BYTES, "seed {seed} of {name}, {} bytes, takes {peak} bytes", bytes.len());
    }
}

#[test]
fn specimens_are_read() {
    for specimen in files::image_specimens() {
        let outcome = image::decode(&specimen.bytes, &OPTIONS);
        assert!(outcome.is_ok(), "{}: {outcome:?}", specimen.name);
    }
    for specimen in files::exif_specimens().iter().chain(&files::xmp_specimens()) {
        let found = metadata::read(&specimen.bytes).expect("an image");
        assert_eq!(found.make.as_deref(), Some("DJI"), "{}", specimen.name);
        assert_eq!(found.gps.is_some(), !specimen.name.starts_with("tiff"), "{}", specimen.name);
    }
}

#[test]
fn damaged_images_are_errors() {
    hunt(&files::image_specimens(), 60_000, |bytes| {
        if let Ok(decoded) = image::decode(bytes, &OPTIONS) {
            assert_eq!(decoded.luma.data.len(), decoded.luma.width * decoded.luma.height);
            if let Some(rgb) = decoded.rgb {
                assert_eq!(rgb.data.len(), 3 * rgb.width * rgb.height);
                let (column, row) = (decoded.luma.width - 1, decoded.luma.height - 1);
                assert!(rgb.at_pixel(column, row, (column + 1, row + 1)).is_some());
            }
        }
    });
}

#[test]
fn damaged_exif_is_left_out() {
    hunt(&files::exif_specimens(), 40_000, |bytes| drop(metadata::read(bytes)));
}

#[test]
fn damaged_xmp_is_left_out() {
    hunt(&files::xmp_specimens(), 40_000, |bytes| drop(metadata::read(bytes)));
}
