//! The elements of a data set that the reader uses.

use crate::text_header::text_of;
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;

/// Group and number of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Tag(pub u16, pub u16);

impl fmt::Display for Tag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "({:04x},{:04x})", self.0, self.1)
    }
}

/// Every element that is used, with its VR in DICOM PS3.6, for files that do not state it.
const USED: &[(Tag, &[u8; 2])] = &[
    (Tag(0x0008, 0x0008), b"CS"),
    (Tag(0x0008, 0x0018), b"UI"),
    (Tag(0x0008, 0x0060), b"CS"),
    (Tag(0x0008, 0x103e), b"LO"),
    (Tag(0x0018, 0x0050), b"DS"),
    (Tag(0x0018, 0x0088), b"DS"),
    (Tag(0x0018, 0x1060), b"DS"),
    (Tag(0x0018, 0x1120), b"DS"),
    (Tag(0x0020, 0x000e), b"UI"),
    (Tag(0x0020, 0x0012), b"IS"),
    (Tag(0x0020, 0x0032), b"DS"),
    (Tag(0x0020, 0x0037), b"DS"),
    (Tag(0x0020, 0x0100), b"IS"),
    (Tag(0x0020, 0x9113), b"SQ"),
    (Tag(0x0020, 0x9116), b"SQ"),
    (Tag(0x0028, 0x0002), b"US"),
    (Tag(0x0028, 0x0004), b"CS"),
    (Tag(0x0028, 0x0008), b"IS"),
    (Tag(0x0028, 0x0010), b"US"),
    (Tag(0x0028, 0x0011), b"US"),
    (Tag(0x0028, 0x0030), b"DS"),
    (Tag(0x0028, 0x0100), b"US"),
    (Tag(0x0028, 0x0101), b"US"),
    (Tag(0x0028, 0x0102), b"US"),
    (Tag(0x0028, 0x0103), b"US"),
    // US or SS: as the pixels.
    (Tag(0x0028, 0x0120), b"US"),
    (Tag(0x0028, 0x0121), b"US"),
    (Tag(0x0028, 0x1052), b"DS"),
    (Tag(0x0028, 0x1053), b"DS"),
    (Tag(0x0028, 0x1054), b"LO"),
    (Tag(0x0028, 0x3000), b"SQ"),
    (Tag(0x0028, 0x9110), b"SQ"),
    (Tag(0x0028, 0x9145), b"SQ"),
    (Tag(0x5200, 0x9229), b"SQ"),
    (Tag(0x5200, 0x9230), b"SQ"),
];

/// The VR of a used element in PS3.6; `None` if the element is not used.
pub(super) fn used_vr(tag: Tag) -> Option<&'static [u8; 2]> {
    USED.iter().find(|(used, _)| *used == tag).map(|(_, vr)| *vr)
}

/// The value of an element.
#[derive(Clone, Debug)]
pub(super) enum Value {
    /// Its place in the file's bytes.
    Bytes { vr: [u8; 2], big_endian: bool, range: Range<usize> },
    /// Items of a sequence.
    Items(Vec<Elements>),
}

/// The used elements of a data set, or of an item in a sequence.
#[derive(Clone, Debug, Default)]
pub(super) struct Elements(BTreeMap<Tag, Value>);

impl Elements {
    pub fn insert(&mut self, tag: Tag, value: Value) {
        self.0.insert(tag, value);
    }

    pub fn get(&self, tag: Tag) -> Option<&Value> {
        self.0.get(&tag)
    }
}

/// A value as text, several numbers separated by backslashes; the error is the unit in bytes of which its
/// length is not a multiple.
pub(super) fn text(vr: [u8; 2], big_endian: bool, bytes: &[u8]) -> Result<String, usize> {
    fn words<const N: usize>(
        bytes: &[u8],
        big_endian: bool,
        say: impl Fn([u8; N]) -> String,
    ) -> Result<String, usize> {
        let (words, rest) = bytes.as_chunks::<N>();
        if !rest.is_empty() {
            return Err(N);
        }
        let each = words.iter().map(|word| {
            let mut word = *word;
            if big_endian {
                word.reverse();
            }
            say(word)
        });
        Ok(each.collect::<Vec<_>>().join("\\"))
    }
    match &vr {
        b"US" => words(bytes, big_endian, |w| u16::from_le_bytes(w).to_string()),
        b"SS" => words(bytes, big_endian, |w| i16::from_le_bytes(w).to_string()),
        b"UL" => words(bytes, big_endian, |w| u32::from_le_bytes(w).to_string()),
        b"SL" => words(bytes, big_endian, |w| i32::from_le_bytes(w).to_string()),
        b"FL" => words(bytes, big_endian, |w| f32::from_le_bytes(w).to_string()),
        b"FD" => words(bytes, big_endian, |w| f64::from_le_bytes(w).to_string()),
        b"UV" => words(bytes, big_endian, |w| u64::from_le_bytes(w).to_string()),
        b"SV" => words(bytes, big_endian, |w| i64::from_le_bytes(w).to_string()),
        // Texts other than UTF-8 and Latin-1 are shown in the latter; none of them decides anything.
        _ => Ok(text_of(bytes)),
    }
}
