//! VLAD: the sum of each word's residuals, normalised.

use terrane_scene::DESCRIPTOR_LEN;

use super::kmeans::assign;

/// Encodes an image's descriptors.
///
/// Residuals are summed exactly in integers. Each word's part is scaled to length one (intra-normalisation, Arandjelović
/// & Zisserman 2013), so that a repeated pattern does not outweigh the rest; each number is replaced by its signed
/// square root (Jégou & Chum 2012); the whole is scaled to length one, so that a dot product is a similarity.
pub(super) fn encode(words: &[[u8; DESCRIPTOR_LEN]], descriptors: &[[u8; DESCRIPTOR_LEN]]) -> Vec<f32> {
    if words.is_empty() || descriptors.is_empty() {
        return Vec::new();
    }
    let mut residuals = vec![[0i64; DESCRIPTOR_LEN]; words.len()];
    for (descriptor, (word, _)) in descriptors.iter().zip(assign(descriptors, words)) {
        let center = &words[word as usize];
        let sum = &mut residuals[word as usize];
        (0..DESCRIPTOR_LEN).for_each(|k| sum[k] += i64::from(descriptor[k]) - i64::from(center[k]));
    }
    let mut encoded = Vec::with_capacity(words.len() * DESCRIPTOR_LEN);
    for sum in &residuals {
        let length = sum.iter().map(|&value| (value * value) as f64).sum::<f64>().sqrt();
        let scale = if length > 0.0 { 1.0 / length } else { 0.0 };
        encoded.extend(
            sum.iter().map(|&value| (value.unsigned_abs() as f64 * scale).sqrt() * value.signum() as f64),
        );
    }
    let length = encoded.iter().map(|value| value * value).sum::<f64>().sqrt();
    let scale = if length > 0.0 { 1.0 / length } else { 0.0 };
    encoded.into_iter().map(|value| (value * scale) as f32).collect()
}
