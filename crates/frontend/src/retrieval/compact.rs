//! Global descriptors as signed bytes, all of a run in one block of memory.

use super::dot::LANES;

/// The global descriptors of a run, one an image: some hundred bytes each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CompactDescriptors {
    /// Bytes of one, a multiple of 32.
    stride: usize,
    values: Vec<i8>,
    /// One over the length of each; zero where there is none.
    inverse_lengths: Vec<f32>,
}

impl CompactDescriptors {
    /// An empty set whose descriptors have `dimensions` numbers each.
    pub fn new(dimensions: usize) -> Self {
        Self { stride: dimensions.next_multiple_of(LANES), values: Vec::new(), inverse_lengths: Vec::new() }
    }

    /// Adds the next image's numbers, scaled so that the largest becomes 127. Numbers that are not finite, none, or too
    /// many, mean an image without a descriptor.
    pub fn push(&mut self, numbers: &[f32]) {
        let largest = numbers.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
        let usable = numbers.len() <= self.stride && numbers.iter().all(|value| value.is_finite());
        let scale = if usable && largest > 0.0 { 127.0 / largest } else { 0.0 };
        let bytes = numbers.iter().take(self.stride).map(|value| {
            // Of a tiny largest number the quotient overflows: that is as good as none.
            let scaled = (value * scale).round();
            if scale.is_finite() && scaled.is_finite() { scaled.clamp(-127.0, 127.0) as i8 } else { 0 }
        });
        self.values.extend(bytes);
        self.push_padding();
    }

    /// Adds the next image's numbers as they are; a value of -128 becomes -127.
    pub fn push_bytes(&mut self, bytes: &[i8]) {
        self.values.extend(bytes.iter().take(self.stride).map(|&value| value.max(-127)));
        self.push_padding();
    }

    fn push_padding(&mut self) {
        let end = (self.inverse_lengths.len() + 1) * self.stride;
        self.values.resize(end, 0);
        self.inverse_lengths.push(inverse_length(&self.values[end - self.stride..]));
    }

    /// How many images there are.
    pub fn len(&self) -> usize {
        self.inverse_lengths.len()
    }

    /// Whether there is no image.
    pub fn is_empty(&self) -> bool {
        self.inverse_lengths.is_empty()
    }

    /// The numbers of an image, zeros when it has none.
    ///
    /// # Panics
    /// When there is no such image.
    pub fn get(&self, index: usize) -> &[i8] {
        &self.values[index * self.stride..(index + 1) * self.stride]
    }

    /// All numbers, image after image.
    pub(super) fn values(&self) -> &[i8] {
        &self.values
    }

    pub(super) fn stride(&self) -> usize {
        self.stride
    }

    /// One over the length of an image's descriptor; zero when it has none.
    pub(super) fn inverse_length(&self, index: usize) -> f32 {
        self.inverse_lengths[index]
    }
}

fn inverse_length(values: &[i8]) -> f32 {
    let squares: i64 = values.iter().map(|&value| i64::from(value) * i64::from(value)).sum();
    if squares > 0 { (1.0 / (squares as f64).sqrt()) as f32 } else { 0.0 }
}
