//! One directory of a TIFF, classic or big, in either byte order: entries that point into the file (TIFF 6.0, section 2).
//!
//! Nothing is copied and nothing is followed: whoever wants another directory asks for it, so that no chain of them can
//! run in circles.

/// The order of a file's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Order {
    Little,
    Big,
}

impl Order {
    pub fn u16(self, bytes: [u8; 2]) -> u16 {
        match self {
            Self::Little => u16::from_le_bytes(bytes),
            Self::Big => u16::from_be_bytes(bytes),
        }
    }

    pub fn u32(self, bytes: [u8; 4]) -> u32 {
        match self {
            Self::Little => u32::from_le_bytes(bytes),
            Self::Big => u32::from_be_bytes(bytes),
        }
    }

    pub fn u64(self, bytes: [u8; 8]) -> u64 {
        match self {
            Self::Little => u64::from_le_bytes(bytes),
            Self::Big => u64::from_be_bytes(bytes),
        }
    }
}

/// The file around its directories.
#[derive(Clone, Copy, Debug)]
pub(crate) struct File<'a> {
    pub bytes: &'a [u8],
    pub order: Order,
    /// BigTIFF: offsets of eight bytes.
    pub is_big: bool,
}

/// A tag with its values.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry<'a> {
    pub tag: u16,
    /// The type's code.
    pub kind: u16,
    pub count: u64,
    /// The bytes of the values, in the file's order.
    pub data: &'a [u8],
    order: Order,
}

/// A directory's entries, in the file's order, without those whose values lie outside of the file.
#[derive(Clone, Debug)]
pub(crate) struct Directory<'a> {
    pub entries: Vec<Entry<'a>>,
    /// Tags whose values lie outside of the file.
    pub lost: Vec<u16>,
}

/// Directories with more entries are not written by anything.
const MAX_ENTRIES: usize = 4096;

impl<'a> File<'a> {
    /// The file and where its first directory lies; `None` when there is no header.
    pub fn open(bytes: &'a [u8]) -> Option<(Self, u64)> {
        let order = match bytes.first_chunk::<2>()? {
            b"II" => Order::Little,
            b"MM" => Order::Big,
            _ => return None,
        };
        let half = |at: usize| Some(order.u16(*bytes.get(at..)?.first_chunk()?));
        match half(2)? {
            42 => {
                let first = order.u32(*bytes.get(4..)?.first_chunk()?);
                Some((Self { bytes, order, is_big: false }, u64::from(first)))
            }
            43 if half(4)? == 8 && half(6)? == 0 => {
                let first = order.u64(*bytes.get(8..)?.first_chunk()?);
                Some((Self { bytes, order, is_big: true }, first))
            }
            _ => None,
        }
    }

    /// The directory at an offset; `None` when it doesn't lie in the file.
    pub fn directory(&self, offset: u64) -> Option<Directory<'a>> {
        let tail = self.bytes.get(usize::try_from(offset).ok()?..)?;
        let (count, table, size) = if self.is_big {
            (self.order.u64(*tail.first_chunk()?), &tail[8..], 20)
        } else {
            (u64::from(self.order.u16(*tail.first_chunk()?)), &tail[2..], 12)
        };
        let count = usize::try_from(count).ok().filter(|count| *count <= MAX_ENTRIES)?;
        let table = table.get(..count.checked_mul(size)?)?;
        let mut directory = Directory { entries: Vec::with_capacity(count), lost: Vec::new() };
        for record in table.chunks_exact(size) {
            let tag = self.order.u16([record[0], record[1]]);
            match self.entry(tag, record) {
                Some(entry) => directory.entries.push(entry),
                None => directory.lost.push(tag),
            }
        }
        Some(directory)
    }

    fn entry(&self, tag: u16, record: &'a [u8]) -> Option<Entry<'a>> {
        let kind = self.order.u16([record[2], record[3]]);
        let (count, inline) = if self.is_big {
            (self.order.u64(*record.get(4..)?.first_chunk()?), &record[12..])
        } else {
            (u64::from(self.order.u32(*record.get(4..)?.first_chunk()?)), &record[8..])
        };
        let length = usize::try_from(count.checked_mul(size_of_kind(kind)?)?).ok()?;
        let data = if length <= inline.len() {
            &inline[..length]
        } else {
            let offset = match inline.first_chunk::<8>().filter(|_| self.is_big) {
                Some(wide) => self.order.u64(*wide),
                None => u64::from(self.order.u32(*inline.first_chunk()?)),
            };
            let start = usize::try_from(offset).ok()?;
            self.bytes.get(start..start.checked_add(length)?)?
        };
        Some(Entry { tag, kind, count, data, order: self.order })
    }
}

/// Bytes of a value of each type, BigTIFF's among them.
fn size_of_kind(kind: u16) -> Option<u64> {
    match kind {
        1 | 2 | 6 | 7 => Some(1),
        3 | 8 => Some(2),
        4 | 9 | 11 | 13 => Some(4),
        5 | 10 | 12 | 16 | 17 | 18 => Some(8),
        _ => None,
    }
}

impl Entry<'_> {
    /// A value as an unsigned integer.
    pub fn unsigned_at(&self, index: usize) -> Option<u64> {
        let value = |size: usize| self.data.get(index.checked_mul(size)?..);
        match self.kind {
            1 | 7 => Some(u64::from(*value(1)?.first()?)),
            3 => Some(u64::from(self.order.u16(*value(2)?.first_chunk()?))),
            4 | 13 => Some(u64::from(self.order.u32(*value(4)?.first_chunk()?))),
            16 | 18 => Some(self.order.u64(*value(8)?.first_chunk()?)),
            _ => None,
        }
    }

    /// All values as unsigned integers; `None` when they are of another type.
    pub fn unsigned(&self) -> Option<Vec<u64>> {
        (0..usize::try_from(self.count).ok()?).map(|index| self.unsigned_at(index)).collect()
    }
}

impl<'a> Directory<'a> {
    /// The entry of a tag.
    pub fn entry(&self, tag: u16) -> Option<&Entry<'a>> {
        self.entries.iter().find(|entry| entry.tag == tag)
    }

    /// The first value of a tag as an unsigned integer.
    pub fn unsigned(&self, tag: u16) -> Option<u64> {
        self.entry(tag)?.unsigned_at(0)
    }
}
