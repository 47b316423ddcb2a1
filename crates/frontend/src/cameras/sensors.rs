//! Widths of the sensors of cameras that are common in the air, from the makers' data sheets.
//!
//! Only cameras whose files lack a usable focal-plane resolution, or whose 35 mm equivalent refers to another crop, need
//! to stand here; any other is served by its EXIF.

/// Width of the longer side, in millimetres, of sensors of a nominal type.
const TYPE_1_2_3: f64 = 6.17;
const TYPE_1_2: f64 = 6.4;
const TYPE_1_1_3: f64 = 9.6;
const TYPE_1: f64 = 13.2;
const FOUR_THIRDS: f64 = 17.3;
const FULL_FRAME: f64 = 35.9;

/// Maker (a prefix, upper case), model (upper case), width in millimetres.
const SENSORS: [(&str, &str, f64); 34] = [
    ("DJI", "FC300C", TYPE_1_2_3), // Phantom 3 Standard
    ("DJI", "FC300S", TYPE_1_2_3), // Phantom 3 Advanced
    ("DJI", "FC300X", TYPE_1_2_3), // Phantom 3 Professional
    ("DJI", "FC300SE", TYPE_1_2_3),
    ("DJI", "FC330", TYPE_1_2_3),      // Phantom 4
    ("DJI", "FC350", TYPE_1_2_3),      // Zenmuse X3
    ("DJI", "FC220", TYPE_1_2_3),      // Mavic Pro
    ("DJI", "FC2103", TYPE_1_2_3),     // Mavic Air
    ("DJI", "FC2204", TYPE_1_2_3),     // Mavic 2 Zoom
    ("DJI", "FC7203", TYPE_1_2_3),     // Mavic Mini
    ("DJI", "FC7303", TYPE_1_2_3),     // Mini 2
    ("DJI", "FC3170", TYPE_1_2),       // Mavic Air 2
    ("DJI", "FC3582", TYPE_1_1_3),     // Mini 3 Pro
    ("DJI", "FC3411", TYPE_1),         // Air 2S
    ("DJI", "FC6310", TYPE_1),         // Phantom 4 Pro
    ("DJI", "FC6310S", TYPE_1),        // Phantom 4 Pro V2
    ("DJI", "FC6310R", TYPE_1),        // Phantom 4 RTK
    ("DJI", "FC6510", TYPE_1),         // Zenmuse X4S
    ("HASSELBLAD", "L1D-20C", TYPE_1), // Mavic 2 Pro
    ("DJI", "L1D-20C", TYPE_1),
    ("HASSELBLAD", "L2D-20C", FOUR_THIRDS), // Mavic 3
    ("DJI", "M3E", FOUR_THIRDS),            // Mavic 3 Enterprise
    ("DJI", "FC550", FOUR_THIRDS),          // Zenmuse X5
    ("DJI", "FC550RAW", FOUR_THIRDS),
    ("DJI", "FC6520", FOUR_THIRDS), // Zenmuse X5S
    ("DJI", "ZENMUSEP1", FULL_FRAME),
    ("SONY", "DSC-RX1RM2", FULL_FRAME),
    ("SONY", "DSC-RX100", TYPE_1),
    ("SONY", "DSC-WX220", TYPE_1_2_3),
    ("SONY", "ILCE-5100", 23.5),
    ("SONY", "ILCE-6000", 23.5),
    ("SONY", "ILCE-7R", FULL_FRAME),
    ("CANON", "CANON POWERSHOT S110", 7.44),
    ("CANON", "CANON POWERSHOT S100", 7.44),
];

/// The width of a camera's sensor, if it is in the table.
pub(super) fn width_mm(make: Option<&str>, model: Option<&str>) -> Option<f64> {
    let (make, model) = (make?.to_ascii_uppercase(), model?.to_ascii_uppercase());
    SENSORS
        .iter()
        .find(|(sensor_make, sensor_model, _)| make.starts_with(sensor_make) && model == *sensor_model)
        .map(|(_, _, width)| *width)
}
