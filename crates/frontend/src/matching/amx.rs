//! AMX: tiles of 32 rows by 32 columns with `tdpbuud`, exact in integers.
//!
//! The instructions are not stable in Rust, so one block of assembly computes a strip of 32 rows against up to 256
//! columns. Products of unsigned bytes need no offset. The scores are settled as in the AVX-512 path.

use std::arch::asm;
use std::arch::x86_64::*;
use std::sync::OnceLock;

use terrane_scene::DESCRIPTOR_LEN;

use super::avx512::{self, GROUP, State, WIDTH};
use super::nearest::{Best, Nearest};
use super::pack::{Form, Packed};

/// Rows of a strip: two tiles.
const STRIP: usize = 32;
/// Rows that are settled at once.
const SETTLED: usize = avx512::ROWS;
/// Groups of 32 columns that one block of assembly computes: 32 KiB of columns and as much of products.
const GROUPS_AT_ONCE: usize = 8;

/// The first side: descriptors as they are, and what is known of each.
pub(super) struct Rows {
    bytes: Vec<[u8; DESCRIPTOR_LEN]>,
    packed: Packed<SETTLED>,
}

/// The second side.
pub(super) type Columns = Packed<WIDTH>;

/// Products of 32 rows with 32 columns: four tiles of 16 by 16, the first rows first.
#[derive(Clone)]
#[repr(C, align(64))]
struct Products([[[i32; WIDTH]; WIDTH]; 4]);

/// What `ldtilecfg` reads (Intel 2023, Software Developer's Manual, volume 1, 18.2).
#[repr(C, align(64))]
struct TileConfig {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

/// All eight tiles are 16 rows of 64 bytes.
static CONFIG: TileConfig = TileConfig {
    palette: 1,
    start_row: 0,
    reserved: [0; 14],
    row_bytes: [64, 64, 64, 64, 64, 64, 64, 64, 0, 0, 0, 0, 0, 0, 0, 0],
    rows: [16, 16, 16, 16, 16, 16, 16, 16, 0, 0, 0, 0, 0, 0, 0, 0],
};

/// Whether this processor can run this path and the system has allowed it. The system is asked once.
pub(super) fn is_available() -> bool {
    static AVAILABLE: OnceLock<bool> = OnceLock::new();
    *AVAILABLE.get_or_init(|| avx512::is_available() && has_instructions() && is_permitted())
}

fn has_instructions() -> bool {
    if __cpuid(0).eax < 7 {
        return false;
    }
    let tiles_and_bytes = (1 << 24) | (1 << 25);
    __cpuid_count(7, 0).edx & tiles_and_bytes == tiles_and_bytes
}

/// Asks Linux for the use of tile registers, for all threads of the process.
#[cfg(target_os = "linux")]
fn is_permitted() -> bool {
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: u64 = 0x1023;
    const XFEATURE_XTILEDATA: u64 = 18;
    let outcome: i64;
    // SAFETY: this system call takes two integers and touches no memory of ours; the kernel overwrites rcx and r11.
    unsafe {
        asm!(
            "syscall",
            inlateout("rax") ARCH_PRCTL => outcome,
            in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") XFEATURE_XTILEDATA,
            out("rcx") _,
            out("r11") _,
            options(nostack),
        );
    }
    outcome == 0
}

#[cfg(not(target_os = "linux"))]
fn is_permitted() -> bool {
    false
}

/// Lays out the first side.
pub(super) fn rows(descriptors: &[[u8; DESCRIPTOR_LEN]]) -> Rows {
    let packed = Packed::new(descriptors, Form::Unsigned, STRIP / SETTLED);
    let mut bytes: Vec<_> = packed.order.iter().map(|&source| descriptors[source as usize]).collect();
    bytes.resize(packed.num_lanes(), [0; DESCRIPTOR_LEN]);
    Rows { bytes, packed }
}

/// Lays out the second side.
pub(super) fn columns(descriptors: &[[u8; DESCRIPTOR_LEN]]) -> Columns {
    Packed::new(descriptors, Form::Unsigned, GROUP)
}

/// Nearest neighbours in both directions.
///
/// # Panics
/// On a processor without AMX, or where the system refuses it.
pub(super) fn nearest(rows: &Rows, columns: &Columns) -> Nearest {
    assert!(is_available(), "this path needs AMX");
    let mut state =
        State { row_best: Best::new(rows.bytes.len()), column_best: Best::new(columns.num_lanes()) };
    // SAFETY: the processor has AVX-512 F, as `is_available` has just found.
    unsafe { sweep(rows, columns, &mut state) };
    Nearest {
        rows: state.row_best.neighbours(&rows.packed.order, &columns.order),
        columns: state.column_best.neighbours(&columns.order, &rows.packed.order),
    }
}

#[target_feature(enable = "avx512f")]
fn sweep(rows: &Rows, columns: &Columns, state: &mut State) {
    let mut products = vec![Products([[[0; WIDTH]; WIDTH]; 4]); GROUPS_AT_ONCE];
    let groups = columns.blocks.as_chunks::<GROUP>().0;
    for (first_group, at_once) in groups.chunks(GROUPS_AT_ONCE).enumerate() {
        for (strip, bytes) in rows.bytes.as_chunks::<STRIP>().0.iter().enumerate() {
            multiply(bytes, at_once, &mut products);
            for (within, products) in products[..at_once.len()].iter().enumerate() {
                let group = (first_group * GROUPS_AT_ONCE + within) * GROUP;
                settle(rows, columns, (strip, group), products, state);
            }
        }
    }
}

#[target_feature(enable = "avx512f")]
#[inline]
fn settle(
    rows: &Rows,
    columns: &Columns,
    (strip, group): (usize, usize),
    products: &Products,
    state: &mut State,
) {
    let column_lanes = [&columns.lanes[group], &columns.lanes[group + 1]];
    for part in 0..STRIP / SETTLED {
        let (tile, first_row) = (2 * (part / 2), SETTLED * (part % 2));
        let mut dots = [[_mm512_setzero_si512(); GROUP]; SETTLED];
        for r in 0..SETTLED {
            for c in 0..GROUP {
                dots[r][c] = avx512::load(&products.0[tile + c][first_row + r]);
            }
        }
        let strip = strip * (STRIP / SETTLED) + part;
        avx512::settle(&dots, &rows.packed.lanes[strip], column_lanes, (strip, group), state);
    }
}

/// Products of 32 rows with each of the groups of 32 columns, which must not be more than there is room for.
fn multiply(
    rows: &[[u8; DESCRIPTOR_LEN]; STRIP],
    groups: &[[super::pack::Block<WIDTH>; GROUP]],
    products: &mut [Products],
) {
    assert!(groups.len() <= products.len() && is_available());
    if groups.is_empty() {
        return;
    }
    // SAFETY: AMX is there and permitted (asserted). Tiles are 16 rows of 64 bytes. Rows: 32 of 128 bytes, read at a
    // stride of 128 from offsets 0, 64 (left and right halves) and 2048 (the lower 16). Columns: each group is two
    // blocks of 2048 bytes, each 32 rows of 64 bytes, read at a stride of 64. Products: 4096 bytes a group, written as
    // four tiles at a stride of 64. The loop runs once a group, and there are as many products (asserted). All tiles
    // are released before the block ends, so that none of their state leaves it.
    unsafe {
        asm!(
            "ldtilecfg [{config}]",
            "2:",
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "tileloadd tmm4, [{rows} + {row_stride}*1]",
            "tileloadd tmm5, [{rows} + {row_stride}*1 + 2048]",
            "tileloadd tmm6, [{columns} + {stride}*1]",
            "tileloadd tmm7, [{columns} + {stride}*1 + 2048]",
            "tdpbuud tmm0, tmm4, tmm6",
            "tdpbuud tmm1, tmm4, tmm7",
            "tdpbuud tmm2, tmm5, tmm6",
            "tdpbuud tmm3, tmm5, tmm7",
            "tileloadd tmm4, [{rows} + {row_stride}*1 + 64]",
            "tileloadd tmm5, [{rows} + {row_stride}*1 + 2112]",
            "tileloadd tmm6, [{columns} + {stride}*1 + 1024]",
            "tileloadd tmm7, [{columns} + {stride}*1 + 3072]",
            "tdpbuud tmm0, tmm4, tmm6",
            "tdpbuud tmm1, tmm4, tmm7",
            "tdpbuud tmm2, tmm5, tmm6",
            "tdpbuud tmm3, tmm5, tmm7",
            "tilestored [{products} + {stride}*1], tmm0",
            "tilestored [{products} + {stride}*1 + 1024], tmm1",
            "tilestored [{products} + {stride}*1 + 2048], tmm2",
            "tilestored [{products} + {stride}*1 + 3072], tmm3",
            "add {columns}, 4096",
            "add {products}, 4096",
            "dec {left}",
            "jnz 2b",
            "tilerelease",
            config = in(reg) &raw const CONFIG,
            rows = in(reg) rows.as_ptr(),
            row_stride = in(reg) DESCRIPTOR_LEN,
            stride = in(reg) 64_usize,
            columns = inout(reg) groups.as_ptr() => _,
            products = inout(reg) products.as_mut_ptr() => _,
            left = inout(reg) groups.len() => _,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack),
        );
    }
}
