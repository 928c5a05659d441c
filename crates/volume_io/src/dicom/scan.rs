//! Walks a DICOM file: collects the elements that the reader uses, checks every length on the way against the
//! bytes, and skips everything else, whatever it holds. Nothing after the pixels is looked at.
//!
//! Source: DICOM PS3.5 section 7 (data element structure, sequences, encapsulated pixel data), section 6.2.2
//! (UN) and PS3.10 section 7 (file meta group).

use super::elements::{Elements, Tag, Value, used_vr};
use crate::error::VolumeError;
use crate::scalar::Scalar;
use std::cell::Cell;
use std::ops::Range;
use std::path::Path;

/// Deepest accepted nesting of sequences; real files stay below ten.
const MAX_DEPTH: usize = 16;
/// Largest number of elements and items that are collected, since each takes up to 30 times its bytes in the
/// file: an enhanced image has 16 per frame.
const MOST_KEPT: usize = 1 << 21;
const _: () = assert!(MOST_KEPT == 32 * voxel_grid::MAX_VOXELS_ALONG_AXIS);
const UNDEFINED: u32 = 0xffff_ffff;
const ITEM: Tag = Tag(0xfffe, 0xe000);
const ITEM_END: Tag = Tag(0xfffe, 0xe00d);
const SEQUENCE_END: Tag = Tag(0xfffe, 0xe0dd);
const PIXEL_DATA: Tag = Tag(0x7fe0, 0x0010);
const FLOAT_PIXEL_DATA: Tag = Tag(0x7fe0, 0x0008);
const DOUBLE_PIXEL_DATA: Tag = Tag(0x7fe0, 0x0009);

/// How a supported file stores its voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PixelCodec {
    Native,
    Rle,
    Jpeg,
    JpegLs,
    Jpeg2000,
    /// One that is not read.
    Unsupported,
}

/// Location of the pixels in the scanned bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Pixels {
    /// A single value; `words` if it consists of 16-bit words in the file's byte order.
    Native { value: Range<usize>, words: bool },
    /// Floats of this type.
    Floats { value: Range<usize>, scalar: Scalar },
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

const fn native(explicit_vr: bool, big_endian: bool, name: &'static str) -> Transfer {
    Transfer { explicit_vr, big_endian, deflated: false, codec: PixelCodec::Native, name }
}

pub(crate) const IMPLICIT: Transfer = native(false, false, "implicit VR little-endian");
pub(crate) const EXPLICIT: Transfer = native(true, false, "explicit VR little-endian");

/// The supported transfer syntaxes, and names for the unsupported ones. Every compressed one has explicit
/// VRs, little-endian (PS3.5 annex A.4).
fn transfer(uid: &str) -> Transfer {
    let packed =
        |codec, name| Transfer { explicit_vr: true, big_endian: false, deflated: false, codec, name };
    let refused = match uid {
        "1.2.840.10008.1.2" => return IMPLICIT,
        "1.2.840.10008.1.2.1" => return EXPLICIT,
        "1.2.840.10008.1.2.2" => return native(true, true, "explicit VR big-endian"),
        "1.2.840.10008.1.2.1.99" => {
            return Transfer { deflated: true, ..native(true, false, "deflated") };
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
    packed(PixelCodec::Unsupported, refused)
}

/// The file meta group.
pub(crate) struct Meta {
    pub transfer: Transfer,
    /// Start of the data set.
    pub end: usize,
    /// Error for an unsupported transfer syntax.
    pub refused: Option<VolumeError>,
}

/// Reads the file meta group from byte `start`. It ends where its elements do; its stated length is not
/// needed, and wrong in some files.
///
/// # Errors
/// `Truncated` if a length reaches past the file; `Header` for a malformed group.
pub(crate) fn meta_group(path: &Path, bytes: &[u8], start: usize) -> Result<Meta, VolumeError> {
    let meta = Scanner { path, bytes, explicit_vr: true, big_endian: false, kept: &Cell::new(0) };
    let mut at = start;
    let mut uid = None;
    while meta.u16(at) == Some(0x0002) {
        let element = meta.element(at)?;
        let end = meta.value_end(&element, bytes.len())?;
        if element.tag == Tag(0x0002, 0x0010) {
            let text = String::from_utf8_lossy(&bytes[element.value..end]);
            uid = Some(text.trim_end_matches(['\0', ' ']).to_string());
        }
        at = end;
    }
    let uid = uid.ok_or_else(|| {
        meta.malformed("(0002,0010) TransferSyntaxUID", "no value".into(), "a transfer syntax")
    })?;
    let transfer = transfer(&uid);
    let refused = (transfer.codec == PixelCodec::Unsupported).then(|| {
        VolumeError::unsupported(
            path,
            "(0002,0010) TransferSyntaxUID",
            format!("{uid} ({})", transfer.name),
            "an uncompressed, deflated, RLE, JPEG, JPEG-LS or JPEG 2000 file; convert it, for example with \
             `gdcmconv --raw`",
        )
    });
    Ok(Meta { transfer, end: at, refused })
}

/// Collects the used elements of a data set into `found`, up to its pixels, which it returns. After an error
/// `found` holds what came before.
///
/// # Errors
/// `Truncated` if a length reaches past the bytes; `Header` for a malformed structure.
pub(crate) fn data_set(
    path: &Path,
    bytes: &[u8],
    start: usize,
    transfer: Transfer,
    found: &mut Elements,
) -> Result<Option<Pixels>, VolumeError> {
    let Transfer { explicit_vr, big_endian, .. } = transfer;
    let scanner = Scanner { path, bytes, explicit_vr, big_endian, kept: &Cell::new(0) };
    let mut at = start;
    while at < bytes.len() {
        let element = scanner.element(at)?;
        if let Some(pixels) = scanner.pixels(&element)? {
            return Ok(Some(pixels));
        }
        if element.tag.0 == 0xfffe {
            return Err(scanner.stray_item(&element));
        }
        at = scanner.take(&element, bytes.len(), 0, Some(found))?;
    }
    Ok(None)
}

struct Scanner<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    explicit_vr: bool,
    big_endian: bool,
    /// Number of elements and items collected so far.
    kept: &'a Cell<usize>,
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
    tag: Tag,
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
        let tag = Tag(self.u16(at).ok_or_else(short)?, self.u16(at + 2).ok_or_else(short)?);
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

    /// A scanner for the content of an element: what has VR UN is implicit VR, little-endian inside (PS3.5
    /// section 6.2.2).
    fn inside(&self, element: &Element) -> Scanner<'_> {
        match &element.vr {
            b"UN" => Scanner { explicit_vr: false, big_endian: false, ..*self },
            _ => Scanner { ..*self },
        }
    }

    fn stray_item(&self, element: &Element) -> VolumeError {
        self.malformed(&tag_name(element.tag), "an item outside a sequence".into(), "a data element")
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
    /// Collects the used ones into `found`, if any.
    fn elements(
        &self,
        mut at: usize,
        limit: usize,
        ends: End,
        depth: usize,
        mut found: Option<&mut Elements>,
    ) -> Result<usize, VolumeError> {
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
                return Err(self.stray_item(&element));
            }
            at = self.take(&element, limit, depth, found.as_deref_mut())?;
        }
        if ends == End::Delimiter {
            return Err(self.truncated("sequence item".into(), limit, limit as u64 + 8));
        }
        Ok(at)
    }

    /// Counts an element or item that is collected.
    fn count_kept(&self) -> Result<(), VolumeError> {
        self.kept.set(self.kept.get() + 1);
        if self.kept.get() <= MOST_KEPT {
            return Ok(());
        }
        Err(self.malformed("data set", format!("more than {MOST_KEPT} elements and items"), "fewer"))
    }

    /// Walks one element, with its items if their end is the element's only end or they are used; returns
    /// where it ends.
    fn take(
        &self,
        element: &Element,
        limit: usize,
        depth: usize,
        found: Option<&mut Elements>,
    ) -> Result<usize, VolumeError> {
        if element.tag == PIXEL_DATA && element.length == UNDEFINED {
            return self.fragments(element.value, limit, &mut Vec::new());
        }
        let used = found.zip(used_vr(element.tag));
        if used.is_some() {
            self.count_kept()?;
        }
        let inside = self.inside(element);
        let (end, ends) = match element.length {
            UNDEFINED => (limit, End::Delimiter),
            _ => (self.value_end(element, limit)?, End::Length),
        };
        match used {
            None if ends == End::Length => Ok(end),
            None => inside.items(element.value, end, ends, depth, None),
            Some((found, b"SQ")) => {
                let mut items = Vec::new();
                let end = inside.items(element.value, end, ends, depth, Some(&mut items))?;
                found.insert(element.tag, Value::Items(items));
                Ok(end)
            }
            Some((found, usual)) => {
                let end = self.value_end(element, limit)?;
                let stated = self.explicit_vr && &element.vr != b"UN";
                let vr = if stated { element.vr } else { *usual };
                let big_endian = inside.big_endian;
                found.insert(element.tag, Value::Bytes { vr, big_endian, range: element.value..end });
                Ok(end)
            }
        }
    }

    fn items(
        &self,
        mut at: usize,
        limit: usize,
        ends: End,
        depth: usize,
        mut found: Option<&mut Vec<Elements>>,
    ) -> Result<usize, VolumeError> {
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
            let mut inner = found.is_some().then(Elements::default);
            if inner.is_some() {
                self.count_kept()?;
            }
            at = if item.length == UNDEFINED {
                self.elements(item.value, limit, End::Delimiter, depth + 1, inner.as_mut())?
            } else {
                let end = self.value_end(&item, limit)?;
                match inner.as_mut() {
                    None => end,
                    inner => self.elements(item.value, end, End::Length, depth + 1, inner)?,
                }
            };
            if let Some((found, inner)) = found.as_deref_mut().zip(inner) {
                found.push(inner);
            }
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
            FLOAT_PIXEL_DATA => Pixels::Floats { value, scalar: Scalar::F32 },
            DOUBLE_PIXEL_DATA => Pixels::Floats { value, scalar: Scalar::F64 },
            _ => {
                let words = !self.explicit_vr || matches!(&element.vr, b"OW" | b"SS" | b"US");
                Pixels::Native { value, words }
            }
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

fn tag_name(tag: Tag) -> String {
    let name = if tag == PIXEL_DATA { " PixelData" } else { "" };
    format!("{tag}{name}")
}
