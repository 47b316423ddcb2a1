//! Ids as types, so that an image is never taken for a camera. No arithmetic, no sentinel: absence is `Option`.

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(
            Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, bytemuck::Pod, bytemuck::Zeroable,
        )]
        #[repr(transparent)]
        #[serde(transparent)]
        pub struct $name(pub u32);

        impl $name {
            /// The id as a position in a table that holds every id from zero on.
            pub fn index(self) -> usize {
                self.0 as usize
            }

            /// The id of a position in such a table.
            pub fn from_index(index: usize) -> Self {
                Self(u32::try_from(index).expect("tables hold fewer than 2^32 rows"))
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, "{}", self.0)
            }
        }
    };
}

id!(
    /// A photograph: its place in the run's image table, which is sorted by relative path.
    ImageId
);
id!(
    /// A physical camera: photographs of one camera share intrinsics.
    CameraId
);
id!(
    /// A cluster of the partition.
    ClusterId
);
id!(
    /// A connected component of the result; 0 is the largest.
    ComponentId
);
id!(
    /// A point's place in one reconstruction; it means nothing in another.
    PointIndex
);
