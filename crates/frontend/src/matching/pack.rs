//! Descriptors laid out for the kernels: blocks of `L` descriptors, four bytes of each side by side.

use terrane_scene::DESCRIPTOR_LEN;

/// Groups of four bytes in a descriptor.
pub(super) const QUADS: usize = DESCRIPTOR_LEN / 4;

/// The largest byte for which sums of four products with an offset byte stay within i16: 4 · 127 · 64 = 32,512.
const NARROW_MAX: u8 = 127;

/// Score of a lane that holds no descriptor, added to its scores: below every real score.
const ABSENT: i32 = 1 << 29;

/// `L` descriptors, transposed: word `[quad][lane]` holds bytes `4 quad .. 4 quad + 4` of descriptor `lane`.
#[derive(Clone)]
#[repr(C, align(64))]
pub(super) struct Block<const L: usize>(pub(super) [[i32; L]; QUADS]);

/// How the bytes are stored.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// As they are.
    Unsigned,
    /// Less [`Lanes::offset`].
    Signed,
}

/// What is known of a block of descriptors besides their bytes.
#[derive(Clone)]
pub(super) struct Lanes<const L: usize> {
    /// Whether no byte exceeds 127: the kernels may then add products in i16.
    pub(super) narrow: bool,
    /// Minus the squared length of each descriptor.
    pub(super) minus_norm: [i32; L],
    /// Twice the sum of each descriptor's bytes.
    pub(super) twice_sum: [i32; L],
    /// What was taken from each byte.
    pub(super) offset: i32,
}

/// All descriptors of one image in blocks of `L`.
///
/// Descriptors with a byte above 127 come last, so that few blocks hold one; `order` says where each came from.
pub(super) struct Packed<const L: usize> {
    pub(super) blocks: Vec<Block<L>>,
    pub(super) lanes: Vec<Lanes<L>>,
    pub(super) order: Vec<u32>,
}

impl<const L: usize> Packed<L> {
    /// Packs descriptors; the number of blocks is a multiple of `group`.
    pub(super) fn new(descriptors: &[[u8; DESCRIPTOR_LEN]], form: Form, group: usize) -> Self {
        let is_wide = |at: &u32| descriptors[*at as usize].iter().copied().max() > Some(NARROW_MAX);
        let (wide, mut order): (Vec<u32>, Vec<u32>) = (0..descriptors.len() as u32).partition(is_wide);
        let num_narrow = order.len();
        order.extend(wide);
        let num_blocks = order.len().div_ceil(L).next_multiple_of(group);
        let mut packed =
            Self { blocks: Vec::with_capacity(num_blocks), lanes: Vec::with_capacity(num_blocks), order };
        for block in 0..num_blocks {
            let narrow = ((block + 1) * L).min(packed.order.len()) <= num_narrow;
            packed.push_block(descriptors, block * L, form, narrow);
        }
        packed
    }

    fn push_block(&mut self, descriptors: &[[u8; DESCRIPTOR_LEN]], first: usize, form: Form, narrow: bool) {
        let offset: u8 = match (form, narrow) {
            (Form::Unsigned, _) => 0,
            (Form::Signed, true) => 64,
            (Form::Signed, false) => 128,
        };
        let mut block = Block([[0; L]; QUADS]);
        let mut lanes =
            Lanes { narrow, minus_norm: [-ABSENT; L], twice_sum: [0; L], offset: i32::from(offset) };
        for lane in 0..L {
            let Some(&source) = self.order.get(first + lane) else { break };
            let bytes = &descriptors[source as usize];
            let norm: i32 = bytes.iter().map(|&byte| i32::from(byte) * i32::from(byte)).sum();
            lanes.minus_norm[lane] = -norm;
            lanes.twice_sum[lane] = 2 * bytes.iter().map(|&byte| i32::from(byte)).sum::<i32>();
            for (quad, four) in bytes.as_chunks::<4>().0.iter().enumerate() {
                block.0[quad][lane] = i32::from_le_bytes(four.map(|byte| byte.wrapping_sub(offset)));
            }
        }
        self.blocks.push(block);
        self.lanes.push(lanes);
    }

    /// How many lanes there are, occupied or not.
    pub(super) fn num_lanes(&self) -> usize {
        self.blocks.len() * L
    }
}
