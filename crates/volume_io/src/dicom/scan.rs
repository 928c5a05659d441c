//! Checks the structure of a DICOM file before it goes to a parser that allocates whatever a length field
//! promises.
//!
//! Source: DICOM PS3.5 section 7 (data element structure, sequences, encapsulated pixel data) and PS3.10
//! section 7 (file meta group).

use crate::error::VolumeError;
use dicom_core::VR;
use dicom_core::dictionary::{DataDictionary, DataDictionaryEntry};
use dicom_object::StandardDataDictionary;
use std::ops::Range;
use std::path::Path;

/// Deepest accepted nesting of sequences; real files stay below ten.
const MAX_DEPTH: usize = 16;
const UNDEFINED: u32 = 0xffff_ffff;
const ITEM: (u16, u16) = (0xfffe, 0xe000);
const ITEM_END: (u16, u16) = (0xfffe, 0xe00d);
const SEQUENCE_END: (u16, u16) = (0xfffe, 0xe0dd);
const PIXEL_DATA: (u16, u16) = (0x7fe0, 0x0010);
const FLOAT_PIXEL_DATA: (u16, u16) = (0x7fe0, 0x0008);
const DOUBLE_PIXEL_DATA: (u16, u16) = (0x7fe0, 0x0009);

/// How a supported file stores its voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PixelCodec {
    Native,
    Rle,
    Jpeg,
    JpegLs,
    Jpeg2000,
}

/// Location of the pixels in the scanned bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Pixels {
    /// A single value; `words` if it consists of 16-bit words in the file's byte order.
    Native { value: Range<usize>, words: bool },
    /// 32-bit floats.
    Floats(Range<usize>),
    /// 64-bit floats.
    Doubles(Range<usize>),
    /// Compressed frames: the basic offset table, then the fragments.
    Fragments { offsets: Range<usize>, fragments: Vec<Range<usize>> },
}

/// The encoding of a supported file.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Transfer {
    pub explicit_vr: bool,
    pub big_endian: bool,
    /// The data set is deflated, and must be inflated before it is scanned.
    pub deflated: bool,
    pub codec: PixelCodec,
    pub name: &'static str,
}

/// The supported transfer syntaxes, and names for the unsupported ones.
fn transfer(path: &Path, uid: &str) -> Result<Transfer, VolumeError> {
    let native = |explicit_vr, big_endian, name| {
        Ok(Transfer { explicit_vr, big_endian, deflated: false, codec: PixelCodec::Native, name })
    };
    let packed =
        |codec, name| Ok(Transfer { explicit_vr: true, big_endian: false, deflated: false, codec, name });
    let refused = match uid {
        "1.2.840.10008.1.2" => return native(false, false, "implicit VR little-endian"),
        "1.2.840.10008.1.2.1" => return native(true, false, "explicit VR little-endian"),
        "1.2.840.10008.1.2.2" => return native(true, true, "explicit VR big-endian"),
        "1.2.840.10008.1.2.1.99" => {
            return native(true, false, "deflated").map(|transfer| Transfer { deflated: true, ..transfer });
        }
        "1.2.840.10008.1.2.5" => return packed(PixelCodec::Rle, "RLE lossless"),
        "1.2.840.10008.1.2.4.50" => return packed(PixelCodec::Jpeg, "JPEG baseline"),
        "1.2.840.10008.1.2.4.51" => return packed(PixelCodec::Jpeg, "JPEG extended"),
        "1.2.840.10008.1.2.4.57" | "1.2.840.10008.1.2.4.70" => {
            return packed(PixelCodec::Jpeg, "JPEG lossless");
        }
        "1.2.840.10008.1.2.4.80" => return packed(PixelCodec::JpegLs, "JPEG-LS lossless"),
        "1.2.840.10008.1.2.4.81" => return packed(PixelCodec::JpegLs, "JPEG-LS near-lossless"),
        "1.2.840.10008.1.2.4.90" => return packed(PixelCodec::Jpeg2000, "JPEG 2000 lossless"),
        "1.2.840.10008.1.2.4.91" => return packed(PixelCodec::Jpeg2000, "JPEG 2000"),
        "1.2.840.10008.1.2.4.92" | "1.2.840.10008.1.2.4.93" => "JPEG 2000 part 2, several components",
        "1.2.840.10008.1.2.4.201" | "1.2.840.10008.1.2.4.202" | "1.2.840.10008.1.2.4.203" => {
            "high-throughput JPEG 2000"
        }
        "1.2.840.10008.1.2.4.110" | "1.2.840.10008.1.2.4.111" | "1.2.840.10008.1.2.4.112" => "JPEG XL",
        _ => "unknown",
    };
    Err(VolumeError::unsupported(
        path,
        "(0002,0010) TransferSyntaxUID",
        format!("{uid} ({refused})"),
        "an uncompressed, deflated, RLE, JPEG, JPEG-LS or JPEG 2000 file; convert it, for example with \
         `gdcmconv --raw`",
    ))
}

/// Reads the file meta group from byte `at`; returns the transfer syntax and the start of the data set.
///
/// # Errors
/// `Truncated` if a length reaches past the file; `Header` for a malformed group; `Unsupported` for an
/// unsupported transfer syntax.
pub(crate) fn meta_group(path: &Path, bytes: &[u8], start: usize) -> Result<(Transfer, usize), VolumeError> {
    let meta = Scanner { path, bytes, explicit_vr: true, big_endian: false };
    let mut at = start;
    let mut uid = None;
    // End of the group according to its length field.
    let mut told = None;
    while meta.u16(at) == Some(0x0002) {
        let element = meta.element(at)?;
        let end = meta.value_end(&element, bytes.len())?;
        if element.tag == (0x0002, 0x0010) {
            let text = String::from_utf8_lossy(&bytes[element.value..end]);
            uid = Some(text.trim_end_matches(['\0', ' ']).to_string());
        }
        if element.tag == (0x0002, 0x0000) {
            told = meta.u32(element.value).map(|length| end as u64 + u64::from(length));
        }
        at = end;
    }
    if let Some(told) = told.filter(|told| *told != at as u64) {
        let given = format!("a file meta group ending at byte {told}");
        let expected = format!("byte {at}, where it ends");
        return Err(meta.malformed("(0002,0000) FileMetaInformationGroupLength", given, &expected));
    }
    let uid = uid.ok_or_else(|| {
        meta.malformed("(0002,0010) TransferSyntaxUID", "no value".into(), "a transfer syntax")
    })?;
    Ok((transfer(path, &uid)?, at))
}

/// Whether elements carry their value representation (PS3.5 section 7.1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Vr {
    Explicit,
    Implicit,
}

/// The transfer syntax of a data set without file meta group: implicit, or explicit if a value representation
/// follows the first tag (PS3.5 section 7.1).
pub(crate) fn bare(vr: Vr) -> Transfer {
    let (explicit_vr, name) = match vr {
        Vr::Explicit => (true, "explicit VR little-endian"),
        Vr::Implicit => (false, "implicit VR little-endian"),
    };
    Transfer { explicit_vr, big_endian: false, deflated: false, codec: PixelCodec::Native, name }
}

/// Checks every length in a data set against the bytes; returns its pixels and the byte at which they begin
/// (the end if there are none).
///
/// # Errors
/// `Truncated` if a length reaches past the bytes; `Header` for a malformed structure.
pub(crate) fn data_set(
    path: &Path,
    bytes: &[u8],
    start: usize,
    transfer: Transfer,
) -> Result<(usize, Option<Pixels>), VolumeError> {
    let scanner = Scanner { path, bytes, explicit_vr: transfer.explicit_vr, big_endian: transfer.big_endian };
    scanner.elements(start, bytes.len(), End::Length, 0)?;
    let mut at = start;
    while at < bytes.len() {
        let element = scanner.element(at)?;
        if let Some(pixels) = scanner.pixels(&element)? {
            return Ok((at, Some(pixels)));
        }
        at = scanner.element_end(&element, bytes.len(), 0)?;
    }
    Ok((at, None))
}

struct Scanner<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    explicit_vr: bool,
    big_endian: bool,
}

/// What ends a sequence or an item (PS3.5 section 7.5).
#[derive(Clone, Copy, PartialEq, Eq)]
enum End {
    /// Its length.
    Length,
    /// A delimiter, which is required.
    Delimiter,
}

struct Element {
    tag: (u16, u16),
    vr: [u8; 2],
    /// Start of the value.
    value: usize,
    length: u32,
}

impl Scanner<'_> {
    fn u16(&self, at: usize) -> Option<u16> {
        let word: [u8; 2] = self.bytes.get(at..at.checked_add(2)?)?.try_into().ok()?;
        Some(if self.big_endian { u16::from_be_bytes(word) } else { u16::from_le_bytes(word) })
    }

    fn u32(&self, at: usize) -> Option<u32> {
        let word: [u8; 4] = self.bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(if self.big_endian { u32::from_be_bytes(word) } else { u32::from_le_bytes(word) })
    }

    fn malformed(&self, field: &str, given: String, expected: &str) -> VolumeError {
        VolumeError::header(self.path, field, given, expected)
    }

    fn truncated(&self, field: String, given_bytes: usize, expected_bytes: u64) -> VolumeError {
        VolumeError::truncated(self.path, field, [given_bytes as u64, expected_bytes])
    }

    /// The element header at `at`; item tags have no VR in any encoding.
    fn element(&self, at: usize) -> Result<Element, VolumeError> {
        let short = || self.truncated("data element header".into(), self.bytes.len().saturating_sub(at), 8);
        let tag = (self.u16(at).ok_or_else(short)?, self.u16(at + 2).ok_or_else(short)?);
        if tag.0 == 0xfffe || !self.explicit_vr {
            let length = self.u32(at + 4).ok_or_else(short)?;
            return Ok(Element { tag, vr: [0; 2], value: at + 8, length });
        }
        let vr: [u8; 2] = self.bytes.get(at + 4..at + 6).and_then(|v| v.try_into().ok()).ok_or_else(short)?;
        match &vr {
            b"OB" | b"OD" | b"OF" | b"OL" | b"OV" | b"OW" | b"SQ" | b"SV" | b"UC" | b"UN" | b"UR" | b"UT"
            | b"UV" => {
                let length = self.u32(at + 8).ok_or_else(short)?;
                Ok(Element { tag, vr, value: at + 12, length })
            }
            b"AE" | b"AS" | b"AT" | b"CS" | b"DA" | b"DS" | b"DT" | b"FD" | b"FL" | b"IS" | b"LO" | b"LT"
            | b"PN" | b"SH" | b"SL" | b"SS" | b"ST" | b"TM" | b"UI" | b"UL" | b"US" => {
                let length = self.u16(at + 6).ok_or_else(short)?;
                Ok(Element { tag, vr, value: at + 8, length: u32::from(length) })
            }
            _ => Err(self.malformed(
                &tag_name(tag),
                format!("VR {:?}", String::from_utf8_lossy(&vr)),
                "a VR of DICOM PS3.5",
            )),
        }
    }

    /// Bytes per number in an element's value. The parser reads complete numbers and continues after the last
    /// one: after a partial number, it would take the remaining bytes for the next element, lengths included.
    fn unit(&self, element: &Element) -> u32 {
        let vr = if self.explicit_vr {
            VR::from_binary(element.vr)
        } else {
            let (group, number) = element.tag;
            StandardDataDictionary.by_tag(dicom_core::Tag(group, number)).map(|entry| entry.vr().relaxed())
        };
        match vr {
            Some(VR::OW | VR::SS | VR::US) => 2,
            Some(VR::AT | VR::FL | VR::OF | VR::OL | VR::SL | VR::UL) => 4,
            Some(VR::FD | VR::OD | VR::OV | VR::SV | VR::UV) => 8,
            _ => 1,
        }
    }

    /// The end of a value of defined length; must be within `limit`.
    fn value_end(&self, element: &Element, limit: usize) -> Result<usize, VolumeError> {
        let end = element.value as u64 + u64::from(element.length);
        if end > limit as u64 || element.length == UNDEFINED {
            let there = limit.saturating_sub(element.value);
            return Err(self.truncated(tag_name(element.tag), there, u64::from(element.length)));
        }
        Ok(end as usize)
    }

    /// Walks the elements from `at` to `limit`, or to an item delimiter before it; returns where they end.
    fn elements(&self, mut at: usize, limit: usize, ends: End, depth: usize) -> Result<usize, VolumeError> {
        if depth > MAX_DEPTH {
            return Err(self.malformed(
                "sequence",
                format!("nested deeper than {MAX_DEPTH}"),
                "less nesting",
            ));
        }
        while at < limit {
            let element = self.element(at)?;
            if element.tag == ITEM_END && ends == End::Delimiter {
                return Ok(element.value);
            }
            if element.tag.0 == 0xfffe {
                return Err(self.malformed(
                    &tag_name(element.tag),
                    "an item outside a sequence".into(),
                    "a data element",
                ));
            }
            at = self.element_end(&element, limit, depth)?;
        }
        if ends == End::Delimiter {
            return Err(self.truncated("sequence item".into(), limit, limit as u64 + 8));
        }
        Ok(at)
    }

    /// Walks one element and its items.
    fn element_end(&self, element: &Element, limit: usize, depth: usize) -> Result<usize, VolumeError> {
        if element.tag == PIXEL_DATA && element.length == UNDEFINED {
            return self.fragments(element.value, limit, &mut Vec::new());
        }
        if element.length == UNDEFINED {
            // A UN of undefined length holds implicit-VR items (PS3.5 section 6.2.2).
            let implicit = Scanner { explicit_vr: false, big_endian: false, ..*self };
            let inner = if &element.vr == b"UN" { &implicit } else { self };
            return inner.items(element.value, limit, End::Delimiter, depth);
        }
        let end = self.value_end(element, limit)?;
        let unit = self.unit(element);
        if !element.length.is_multiple_of(unit) {
            let (field, given) = (tag_name(element.tag), format!("{} bytes", element.length));
            return Err(self.malformed(&field, given, &format!("a multiple of {unit} bytes")));
        }
        // In implicit VR a sequence is recognized only by its first item.
        let looks_like_items = !self.explicit_vr
            && element.tag != PIXEL_DATA
            && element.length >= 8
            && (self.u16(element.value), self.u16(element.value + 2)) == (Some(ITEM.0), Some(ITEM.1));
        if &element.vr == b"SQ" || looks_like_items {
            self.items(element.value, end, End::Length, depth)?;
        }
        Ok(end)
    }

    fn items(&self, mut at: usize, limit: usize, ends: End, depth: usize) -> Result<usize, VolumeError> {
        while at < limit {
            let item = self.element(at)?;
            if item.tag == SEQUENCE_END && ends == End::Delimiter {
                return Ok(item.value);
            }
            if item.tag != ITEM {
                return Err(self.malformed(
                    &tag_name(item.tag),
                    "inside a sequence".into(),
                    "a sequence item",
                ));
            }
            at = if item.length == UNDEFINED {
                self.elements(item.value, limit, End::Delimiter, depth + 1)?
            } else {
                let end = self.value_end(&item, limit)?;
                self.elements(item.value, end, End::Length, depth + 1)?
            };
        }
        if ends == End::Delimiter {
            return Err(self.truncated("sequence".into(), limit, limit as u64 + 8));
        }
        Ok(at)
    }

    /// The pixels, if the element holds any.
    fn pixels(&self, element: &Element) -> Result<Option<Pixels>, VolumeError> {
        if ![PIXEL_DATA, FLOAT_PIXEL_DATA, DOUBLE_PIXEL_DATA].contains(&element.tag) {
            return Ok(None);
        }
        if element.tag == PIXEL_DATA && element.length == UNDEFINED {
            let mut items = Vec::new();
            self.fragments(element.value, self.bytes.len(), &mut items)?;
            if items.is_empty() {
                let expected = "an offset table, then fragments";
                return Err(self.malformed(&tag_name(element.tag), "no item".into(), expected));
            }
            let fragments = items.split_off(1);
            return Ok(items.pop().map(|offsets| Pixels::Fragments { offsets, fragments }));
        }
        let value = element.value..self.value_end(element, self.bytes.len())?;
        Ok(Some(match element.tag {
            FLOAT_PIXEL_DATA => Pixels::Floats(value),
            DOUBLE_PIXEL_DATA => Pixels::Doubles(value),
            _ => Pixels::Native { value, words: self.unit(element) == 2 },
        }))
    }

    /// Walks encapsulated pixel data, items of defined length up to the sequence delimiter, and collects
    /// their positions; returns their end.
    fn fragments(
        &self,
        mut at: usize,
        limit: usize,
        items: &mut Vec<Range<usize>>,
    ) -> Result<usize, VolumeError> {
        loop {
            if at >= limit {
                return Err(self.truncated("(7fe0,0010) PixelData".into(), limit, limit as u64 + 8));
            }
            let item = self.element(at)?;
            match item.tag {
                SEQUENCE_END => return Ok(item.value),
                ITEM => {
                    at = self.value_end(&item, limit)?;
                    items.push(item.value..at);
                }
                other => {
                    return Err(self.malformed(&tag_name(other), "inside pixel data".into(), "a fragment"));
                }
            }
        }
    }
}

fn tag_name(tag: (u16, u16)) -> String {
    let name = if tag == PIXEL_DATA { " PixelData" } else { "" };
    format!("({:04x},{:04x}){name}", tag.0, tag.1)
}
