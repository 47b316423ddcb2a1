//! Files that are not read: recognised by their bytes, refused with what to do.

use super::*;

#[test]
fn what_is_no_image_is_refused_with_the_remedy() {
    for (bytes, says, remedy) in [
        (b"".as_slice(), "0 bytes", "copy it again"),
        (b"Dear all, the photographs are on the other drive.\n", "text", "convert it"),
        (b"\x00\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a\x0b", "not a JPEG", "convert it"),
        (&[0; 100], "nothing but zeros", "copy it again"),
        (b"\x00\x00\x00\x18ftypheic\x00\x00\x00\x00", "HEIC", "convert"),
        (b"\x00\x00\x00\x18ftypmif1\x00\x00\x00\x00mif1heic", "HEIF", "convert"),
        (b"\x00\x00\x00\x1cftypmif1\x00\x00\x00\x00mif1avifmiaf", "HEIF", "convert"),
        (b"\x00\x00\x00\x1cftypiso8\x00\x00\x00\x00mif1heicmiaf", "HEIC", "convert"),
        (b"\x00\x00\x00\x1cftypavif\x00\x00\x00\x00avifmif1miaf", "AVIF", "convert"),
        (b"\x00\x00\x00\x18ftypcrx \x00\x00\x00\x00", "CR3", "develop"),
        (b"\x00\x00\x00\x18ftypisom\x00\x00\x02\x00isomiso2", "video", "extract its frames"),
        (b"\x00\x00\x00\x14ftypqt  \x00\x00\x02\x00qt  ", "QuickTime", "extract its frames"),
        (b"\x1a\x45\xdf\xa3\x01\x00\x00\x00", "WebM", "extract its frames"),
        (b"RIFF\x00\x00\x00\x00AVI LIST", "AVI", "extract its frames"),
        (b"II\x2a\x00\x10\x00\x00\x00CR\x02\x00", "CR2", "develop"),
        (b"IIRO\x08\x00\x00\x00", "ORF", "develop"),
        (b"IIU\x00\x18\x00\x00\x00", "RW2", "develop"),
        (b"FUJIFILMCCD-RAW 0201", "RAF", "develop"),
        (b"RIFF\x00\x00\x00\x00WEBPVP8 ", "WebP", "convert"),
        (b"GIF89a\x01\x00\x01\x00", "GIF", "convert"),
        (b"BM\x46\x00\x00\x00\x00\x00\x00\x00\x36\x00\x00\x00\x28\x00\x00\x00\x04\x00\x00\x00\x04\x00\x00\x00\x01", "BMP", "convert"),
        (b"\x00\x00\x00\x0cjP  \x0d\x0a\x87\x0a", "JPEG 2000", "convert"),
        (b"\xff\x4f\xff\x51\x00\x29", "JPEG 2000", "convert"),
        (b"\xff\x0a\xfa\x1f", "JPEG XL", "convert"),
        (b"\x00\x00\x00\x0cJXL \x0d\x0a\x87\x0a", "JPEG XL", "convert"),
        (b"8BPS\x00\x01", "Photoshop", "convert"),
        (b"P6\n640 480\n255\n", "PNM", "convert"),
        (b"%PDF-1.7\n", "PDF", "export the photographs"),
        (b"PK\x03\x04\x14\x00", "ZIP", "export the photographs"),
    ] {
        let error = error_of(bytes).to_string();
        assert!(error.contains(says) && error.contains(remedy), "{says}, {remedy}: {error}");
        assert_eq!(probe(bytes).unwrap_err().to_string(), error);
        assert!(error_of(bytes).is_unsupported() || bytes.is_empty());
    }
}

#[test]
fn names_do_not_matter_and_beginnings_of_every_length_are_safe() {
    for (_, magic, ..) in super::super::format::FOREIGN {
        for len in 0..=magic.len() {
            assert!(probe(&magic[..len]).is_err());
        }
    }
}
