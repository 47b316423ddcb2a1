//! Neighbours in the order that photographs were taken in.

use terrane_scene::{ImageRecord, ImageTable};

/// Pairs of positions in the table that are at most `overlap` apart in their folder's sequence.
pub(super) fn neighbours(table: &ImageTable, overlap: usize) -> Vec<(usize, usize)> {
    let order = order(table);
    let mut pairs = Vec::new();
    for (at, &image) in order.iter().enumerate() {
        for &next in order.iter().skip(at + 1).take(overlap) {
            pairs.push((image, next));
        }
    }
    pairs
}

/// The place of each image of the table in the sequence.
pub(super) fn places(table: &ImageTable) -> Vec<usize> {
    let order = order(table);
    let mut places = vec![0; order.len()];
    order.into_iter().enumerate().for_each(|(place, image)| places[image] = place);
    places
}

/// Folder by folder; within one by time when every image of it has one, else by path. Folders follow each other, so
/// that a sequence that was cut into folders stays in one piece.
fn order(table: &ImageTable) -> Vec<usize> {
    let mut order: Vec<usize> = (0..table.images.len()).collect();
    order.sort_by(|&a, &b| folder(&table.images[a]).cmp(folder(&table.images[b])).then(a.cmp(&b)));
    for group in order.chunk_by_mut(|&a, &b| folder(&table.images[a]) == folder(&table.images[b])) {
        let time = |at: usize| table.images[at].captured_s.filter(|time| time.is_finite());
        if group.iter().all(|&at| time(at).is_some()) {
            group.sort_by(|&a, &b| {
                let times = time(a).unwrap_or_default().total_cmp(&time(b).unwrap_or_default());
                times.then(a.cmp(&b))
            });
        }
    }
    order
}

fn folder(image: &ImageRecord) -> &str {
    image.path.rsplit_once('/').map_or("", |(folder, _)| folder)
}
