//! Camera models by name, number and count of parameters.

use serde::{Deserialize, Serialize};

/// How a ray becomes a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum CameraModel {
    /// f, cx, cy.
    SimplePinhole,
    /// fx, fy, cx, cy.
    Pinhole,
    /// f, cx, cy, k.
    SimpleRadial,
    /// f, cx, cy, k1, k2.
    Radial,
    /// fx, fy, cx, cy, k1, k2, p1, p2.
    #[serde(rename = "OPENCV")]
    OpenCv,
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6.
    #[serde(rename = "FULL_OPENCV")]
    FullOpenCv,
    /// fx, fy, cx, cy, k1, k2, k3, k4.
    #[serde(rename = "OPENCV_FISHEYE")]
    OpenCvFisheye,
    /// fx, fy, cx, cy, omega.
    Fov,
    /// f, cx, cy, k.
    SimpleRadialFisheye,
    /// f, cx, cy, k1, k2.
    RadialFisheye,
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1.
    ThinPrismFisheye,
    /// fx, fy, cx, cy, k0 to k5, p0, p1, s0 to s3.
    RadTanThinPrismFisheye,
    /// f, cx, cy, k.
    SimpleDivision,
    /// fx, fy, cx, cy, k.
    Division,
    /// f, cx, cy.
    SimpleFisheye,
    /// fx, fy, cx, cy.
    Fisheye,
    /// fx, fy, cx, cy, alpha, beta.
    Eucm,
    /// width and height of the whole panorama in pixels, which nothing refines.
    Equirectangular,
}

/// What models share formulas.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Family {
    /// A polynomial or rational distortion of the plane z = 1, or none.
    Perspective,
    /// A polynomial in the angle to the optical axis.
    Fisheye,
    /// A distortion of the radius that is inverted in closed form.
    ClosedRadial,
    /// Longitude and latitude.
    Spherical,
}

impl CameraModel {
    /// Every model, in the order of their COLMAP ids.
    pub const ALL: [CameraModel; 18] = [
        CameraModel::SimplePinhole,
        CameraModel::Pinhole,
        CameraModel::SimpleRadial,
        CameraModel::Radial,
        CameraModel::OpenCv,
        CameraModel::OpenCvFisheye,
        CameraModel::FullOpenCv,
        CameraModel::Fov,
        CameraModel::SimpleRadialFisheye,
        CameraModel::RadialFisheye,
        CameraModel::ThinPrismFisheye,
        CameraModel::RadTanThinPrismFisheye,
        CameraModel::SimpleDivision,
        CameraModel::Division,
        CameraModel::SimpleFisheye,
        CameraModel::Fisheye,
        CameraModel::Eucm,
        CameraModel::Equirectangular,
    ];

    /// COLMAP's number of this model.
    pub fn colmap_id(self) -> i32 {
        match self {
            Self::SimplePinhole => 0,
            Self::Pinhole => 1,
            Self::SimpleRadial => 2,
            Self::Radial => 3,
            Self::OpenCv => 4,
            Self::OpenCvFisheye => 5,
            Self::FullOpenCv => 6,
            Self::Fov => 7,
            Self::SimpleRadialFisheye => 8,
            Self::RadialFisheye => 9,
            Self::ThinPrismFisheye => 10,
            Self::RadTanThinPrismFisheye => 11,
            Self::SimpleDivision => 12,
            Self::Division => 13,
            Self::SimpleFisheye => 14,
            Self::Fisheye => 15,
            Self::Eucm => 16,
            Self::Equirectangular => 17,
        }
    }

    /// The model of a COLMAP number, or `None` when there is none.
    pub fn from_colmap_id(id: i32) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.colmap_id() == id)
    }

    /// COLMAP's name of this model.
    pub fn name(self) -> &'static str {
        match self {
            Self::SimplePinhole => "SIMPLE_PINHOLE",
            Self::Pinhole => "PINHOLE",
            Self::SimpleRadial => "SIMPLE_RADIAL",
            Self::Radial => "RADIAL",
            Self::OpenCv => "OPENCV",
            Self::OpenCvFisheye => "OPENCV_FISHEYE",
            Self::FullOpenCv => "FULL_OPENCV",
            Self::Fov => "FOV",
            Self::SimpleRadialFisheye => "SIMPLE_RADIAL_FISHEYE",
            Self::RadialFisheye => "RADIAL_FISHEYE",
            Self::ThinPrismFisheye => "THIN_PRISM_FISHEYE",
            Self::RadTanThinPrismFisheye => "RAD_TAN_THIN_PRISM_FISHEYE",
            Self::SimpleDivision => "SIMPLE_DIVISION",
            Self::Division => "DIVISION",
            Self::SimpleFisheye => "SIMPLE_FISHEYE",
            Self::Fisheye => "FISHEYE",
            Self::Eucm => "EUCM",
            Self::Equirectangular => "EQUIRECTANGULAR",
        }
    }

    /// The names of all models, for messages.
    pub fn names() -> String {
        Self::ALL.map(Self::name).join(", ")
    }

    /// The model of a name in COLMAP's spelling.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// How many parameters the model has.
    #[inline]
    pub fn num_params(self) -> usize {
        self.num_focal() + 2 + self.num_distortion()
    }

    /// One focal length for both axes, or two; none for a panorama, whose two parameters are its size.
    #[inline]
    pub fn num_focal(self) -> usize {
        match self {
            Self::SimplePinhole
            | Self::SimpleRadial
            | Self::Radial
            | Self::SimpleRadialFisheye
            | Self::RadialFisheye
            | Self::SimpleDivision
            | Self::SimpleFisheye => 1,
            Self::Pinhole
            | Self::OpenCv
            | Self::FullOpenCv
            | Self::OpenCvFisheye
            | Self::Fov
            | Self::ThinPrismFisheye
            | Self::RadTanThinPrismFisheye
            | Self::Division
            | Self::Fisheye
            | Self::Eucm => 2,
            Self::Equirectangular => 0,
        }
    }

    /// How many distortion coefficients follow the principal point.
    #[inline]
    pub fn num_distortion(self) -> usize {
        match self {
            Self::SimplePinhole
            | Self::Pinhole
            | Self::SimpleFisheye
            | Self::Fisheye
            | Self::Equirectangular => 0,
            Self::SimpleRadial
            | Self::Fov
            | Self::SimpleRadialFisheye
            | Self::SimpleDivision
            | Self::Division => 1,
            Self::Radial | Self::RadialFisheye | Self::Eucm => 2,
            Self::OpenCv | Self::OpenCvFisheye => 4,
            Self::FullOpenCv | Self::ThinPrismFisheye => 8,
            Self::RadTanThinPrismFisheye => 12,
        }
    }

    /// Whether the model is a central projection onto the plane z = 1, distorted by polynomials or not at all.
    #[inline]
    pub fn is_perspective(self) -> bool {
        self.family() == Family::Perspective
    }

    /// Whether the model is a panorama of the whole sphere, which has no focal length.
    #[inline]
    pub fn is_spherical(self) -> bool {
        self.family() == Family::Spherical
    }

    #[inline]
    pub(super) fn family(self) -> Family {
        match self {
            Self::SimplePinhole
            | Self::Pinhole
            | Self::SimpleRadial
            | Self::Radial
            | Self::OpenCv
            | Self::FullOpenCv => Family::Perspective,
            Self::OpenCvFisheye
            | Self::SimpleRadialFisheye
            | Self::RadialFisheye
            | Self::ThinPrismFisheye
            | Self::RadTanThinPrismFisheye
            | Self::SimpleFisheye
            | Self::Fisheye => Family::Fisheye,
            Self::Fov | Self::SimpleDivision | Self::Division | Self::Eucm => Family::ClosedRadial,
            Self::Equirectangular => Family::Spherical,
        }
    }
}
