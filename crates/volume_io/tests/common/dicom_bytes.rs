//! Small DICOM Part 10 files built byte by byte from PS3.5 and PS3.10.

use std::path::Path;

/// Parameters of a test's DICOM slice: explicit VR little-endian, int16, slope 1, intercept −1024.
#[derive(Clone)]
pub struct DicomSlice {
    pub series_uid: &'static str,
    pub modality: &'static str,
    pub slope: &'static str,
    pub intercept: Option<&'static str>,
    /// RescaleType: unit of the values.
    pub rescale_type: Option<&'static str>,
    pub position_mm: [f64; 3],
    pub orientation: &'static str,
    pub pixel_spacing: &'static str,
    pub samples_per_pixel: u16,
    pub transfer_syntax: &'static str,
    /// Stored value of every pixel.
    pub stored: i16,
    pub rows: u16,
    pub columns: u16,
    /// Encapsulated fragment instead of uncompressed pixels.
    pub fragment: Option<Vec<u8>>,
    /// GantryDetectorTilt, degrees.
    pub gantry_tilt: Option<&'static str>,
}

impl Default for DicomSlice {
    fn default() -> Self {
        Self {
            series_uid: "1.2.3",
            modality: "CT",
            slope: "1",
            intercept: Some("-1024"),
            rescale_type: None,
            position_mm: [0.0; 3],
            orientation: "1\\0\\0\\0\\1\\0",
            pixel_spacing: "2\\3",
            samples_per_pixel: 1,
            transfer_syntax: "1.2.840.10008.1.2.1",
            stored: 1024,
            rows: 4,
            columns: 5,
            fragment: None,
            gantry_tilt: None,
        }
    }
}

impl DicomSlice {
    pub fn bytes(&self) -> Vec<u8> {
        let mut meta = Vec::new();
        text(&mut meta, (0x0002, 0x0002), b"UI", "1.2.840.10008.5.1.4.1.1.2");
        text(&mut meta, (0x0002, 0x0003), b"UI", "1.2.3.4");
        text(&mut meta, (0x0002, 0x0010), b"UI", self.transfer_syntax);
        text(&mut meta, (0x0002, 0x0012), b"UI", "1.2.3.5");
        let mut out = vec![0; 128];
        out.extend(b"DICM");
        element(&mut out, (0x0002, 0x0000), b"UL", &(meta.len() as u32).to_le_bytes());
        out.extend(meta);
        text(&mut out, (0x0008, 0x0060), b"CS", self.modality);
        text(&mut out, (0x0018, 0x0050), b"DS", "5");
        if let Some(tilt) = self.gantry_tilt {
            text(&mut out, (0x0018, 0x1120), b"DS", tilt);
        }
        text(&mut out, (0x0020, 0x000e), b"UI", self.series_uid);
        let [x, y, z] = self.position_mm;
        text(&mut out, (0x0020, 0x0032), b"DS", &format!("{x}\\{y}\\{z}"));
        text(&mut out, (0x0020, 0x0037), b"DS", self.orientation);
        element(&mut out, (0x0028, 0x0002), b"US", &self.samples_per_pixel.to_le_bytes());
        text(
            &mut out,
            (0x0028, 0x0004),
            b"CS",
            if self.samples_per_pixel == 1 { "MONOCHROME2" } else { "RGB" },
        );
        element(&mut out, (0x0028, 0x0010), b"US", &self.rows.to_le_bytes());
        element(&mut out, (0x0028, 0x0011), b"US", &self.columns.to_le_bytes());
        text(&mut out, (0x0028, 0x0030), b"DS", self.pixel_spacing);
        for (tag, value) in [(0x0100, 16_u16), (0x0101, 16), (0x0102, 15), (0x0103, 1)] {
            element(&mut out, (0x0028, tag), b"US", &value.to_le_bytes());
        }
        if let Some(intercept) = self.intercept {
            text(&mut out, (0x0028, 0x1052), b"DS", intercept);
        }
        text(&mut out, (0x0028, 0x1053), b"DS", self.slope);
        if let Some(kind) = self.rescale_type {
            text(&mut out, (0x0028, 0x1054), b"LO", kind);
        }
        match &self.fragment {
            None => {
                let count = usize::from(self.rows) * usize::from(self.columns);
                let pixels: Vec<u8> =
                    std::iter::repeat_n(self.stored.to_le_bytes(), count).flatten().collect();
                element(&mut out, (0x7fe0, 0x0010), b"OW", &pixels);
            }
            Some(fragment) => {
                tag(&mut out, (0x7fe0, 0x0010));
                out.extend(b"OB\0\0\xff\xff\xff\xff");
                tag(&mut out, (0xfffe, 0xe000));
                out.extend(0_u32.to_le_bytes());
                tag(&mut out, (0xfffe, 0xe000));
                out.extend((fragment.len() as u32).to_le_bytes());
                out.extend(fragment);
                tag(&mut out, (0xfffe, 0xe0dd));
                out.extend(0_u32.to_le_bytes());
            }
        }
        out
    }
}

/// Writes slices as 000.dcm, 001.dcm, … into a folder.
pub fn write_series(folder: &Path, slices: &[DicomSlice]) {
    for (i, slice) in slices.iter().enumerate() {
        std::fs::write(folder.join(format!("{i:03}.dcm")), slice.bytes()).unwrap();
    }
}

fn tag(out: &mut Vec<u8>, (group, element): (u16, u16)) {
    out.extend(group.to_le_bytes());
    out.extend(element.to_le_bytes());
}

fn text(out: &mut Vec<u8>, at: (u16, u16), vr: &[u8; 2], value: &str) {
    let mut bytes = value.as_bytes().to_vec();
    if bytes.len() % 2 == 1 {
        bytes.push(if vr == b"UI" { 0 } else { b' ' });
    }
    element(out, at, vr, &bytes);
}

fn element(out: &mut Vec<u8>, at: (u16, u16), vr: &[u8; 2], value: &[u8]) {
    tag(out, at);
    out.extend(vr);
    if vr == b"OW" {
        out.extend([0, 0]);
        out.extend((value.len() as u32).to_le_bytes());
    } else {
        out.extend((value.len() as u16).to_le_bytes());
    }
    out.extend(value);
}

/// A lossless JPEG (process 14, first-order prediction) of 5 × 4 pixels of 11 bits, all at the initial
/// prediction 2^10 = 1024: one Huffman code, one bit per pixel (ITU-T T.81 annex H).
pub const LOSSLESS_JPEG: [u8; 54] = [
    0xff, 0xd8, 0xff, 0xc3, 0, 11, 11, 0, 4, 0, 5, 1, 1, 0x11, 0, 0xff, 0xc4, 0, 20, 0, 1, 0, 0, 0, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xda, 0, 8, 1, 1, 0, 1, 0, 0, 0, 0, 0x0f, 0xff, 0xd9, 0, 0,
];

/// Transfer syntaxes of JPEG 2000: lossless only, and lossless or lossy.
pub const JPEG_2000_SYNTAXES: [&str; 2] = ["1.2.840.10008.1.2.4.90", "1.2.840.10008.1.2.4.91"];

/// A JPEG 2000 codestream (ITU-T T.800 annex A) of signed 16 bits: one tile, one code-block, one packet of
/// arbitrary bits. Start bytes: SIZ 2, COD 45, QCD 59, SOT 65, packet 79.
pub fn jpeg_2000(rows: u16, columns: u16) -> Vec<u8> {
    // Its header: present, block included, 6 empty bit-planes, 31 coding passes, 20 bytes.
    let packet =
        [[0xc0, 0xfe, 0x45, 0].as_slice(), &std::array::from_fn::<u8, 20, _>(|n| (n * 37 + 11) as u8 & 0x7f)];
    jpeg_2000_of(rows, columns, &packet.concat())
}

/// The same with a given packet.
pub fn jpeg_2000_of(rows: u16, columns: u16, packet: &[u8]) -> Vec<u8> {
    let size = [columns, rows].map(|extent| u32::from(extent).to_be_bytes()).concat();
    let offset = [0; 8];
    let mut data = vec![0xff, 0x4f, 0xff, 0x51, 0, 41, 0, 0];
    data.extend([&size[..], &offset, &size, &offset, &[0, 1, 0x8f, 1, 1]].concat());
    // No precincts, one layer, no decomposition, blocks of 64 x 64, reversible.
    data.extend([0xff, 0x52, 0, 12, 0, 0, 0, 1, 0, 0, 4, 4, 0, 1]);
    // Two guard bits, 16 bits per sample.
    data.extend([0xff, 0x5c, 0, 4, 0x40, 16 << 3]);
    data.extend([0xff, 0x90, 0, 10, 0, 0]);
    data.extend((14 + packet.len() as u32).to_be_bytes());
    data.extend([0, 1, 0xff, 0x93]);
    data.extend(packet);
    data.extend([0xff, 0xd9]);
    data
}
