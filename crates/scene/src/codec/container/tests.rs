//! Round trips, every flipped bit, every truncation, hostile lengths.

use super::*;

fn sample() -> Vec<u8> {
    let mut writer = ArchiveWriter::new(Kind::Record);
    writer.column(Tag(*b"NUMS"), 3, &[1u32, 2, 3], Packing::Raw).unwrap();
    writer.column(Tag(*b"ZERO"), 0, &vec![7u64; 40], Packing::Zstd).unwrap();
    writer.column::<u8>(Tag(*b"NONE"), 0, &[], Packing::Zstd).unwrap();
    writer.json(Tag(*b"JSON"), 0, &("text", 5)).unwrap();
    writer.finish()
}

fn read_all(bytes: &[u8]) -> Result<(), SceneError> {
    let archive = Archive::open(bytes, Kind::Record)?;
    assert_eq!(archive.column::<u32>(Tag(*b"NUMS"), 3)?, [1, 2, 3]);
    assert_eq!(archive.column::<u64>(Tag(*b"ZERO"), 0)?, [7; 40]);
    assert!(archive.column::<u8>(Tag(*b"NONE"), 0)?.is_empty());
    assert_eq!(archive.json::<(String, u32)>(Tag(*b"JSON"), 0)?, ("text".to_owned(), 5));
    Ok(())
}

#[test]
fn what_is_written_is_read() {
    let bytes = sample();
    read_all(&bytes).unwrap();
    assert_eq!(bytes, sample());
    let archive = Archive::open(bytes.as_slice(), Kind::Record).unwrap();
    assert_eq!(archive.items(Tag(*b"NUMS")).collect::<Vec<_>>(), [3]);
    assert_eq!(archive.column_len(Tag(*b"ZERO"), 0).unwrap(), 40);
    assert!(archive.column::<u32>(Tag(*b"NUMS"), 0).unwrap_err().is_corrupt());
    assert!(archive.column::<u64>(Tag(*b"NUMS"), 3).unwrap_err().is_corrupt());
    assert!(Archive::open(bytes.as_slice(), Kind::Pairs).err().unwrap().is_unsupported());
}

#[test]
fn every_flipped_bit_is_found() {
    let bytes = sample();
    for bit in 0..bytes.len() * 8 {
        let mut broken = bytes.clone();
        broken[bit / 8] ^= 1 << (bit % 8);
        let error = read_all(&broken).expect_err("a flipped bit must be found");
        assert!(error.is_corrupt(), "bit {bit}: {error}");
    }
}

#[test]
fn every_truncation_is_found() {
    let bytes = sample();
    for len in 0..bytes.len() {
        assert!(read_all(&bytes[..len]).unwrap_err().is_corrupt(), "{len}");
    }
    let mut longer = bytes.clone();
    longer.push(0);
    assert!(read_all(&longer).unwrap_err().is_corrupt());
}

/// Checksums made right again after the lengths were made wrong: what only a hostile writer does.
#[test]
fn hostile_lengths_are_refused_without_allocating() {
    for (field, value) in [(16usize, u64::MAX - 63), (24, u64::MAX), (24, 1 << 60), (32, 1 << 62), (16, 3)] {
        for section in 0..4usize {
            let mut bytes = sample();
            let at = HEADER_LEN as usize + section * ENTRY_LEN as usize + field;
            bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
            let table_end = pad(HEADER_LEN + 4 * ENTRY_LEN) as usize;
            let table_checksum = xxh3_64(&bytes[64..table_end]);
            bytes[24..32].copy_from_slice(&table_checksum.to_le_bytes());
            let checksum = xxh3_64(&bytes[..56]);
            bytes[56..64].copy_from_slice(&checksum.to_le_bytes());
            assert!(read_all(&bytes).unwrap_err().is_corrupt());
        }
    }
}
