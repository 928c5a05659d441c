//! Helpers for the two formats with text headers (NRRD, MetaImage): number lists and their errors.

use crate::error::VolumeError;
use crate::input::{Codec, open_stream, read_full};
use crate::scalar::{HuSink, Scale};
use std::collections::BTreeMap;
use std::path::Path;

/// Longest accepted text header, bytes.
pub(crate) const MAX_HEADER_BYTES: usize = 1 << 20;

/// A header's bytes as text: UTF-8, or else Latin-1, as older programs write names and comments.
pub(crate) fn text_of(bytes: &[u8]) -> String {
    match std::str::from_utf8(bytes) {
        Ok(text) => text.to_owned(),
        Err(_) => bytes.iter().map(|byte| char::from(*byte)).collect(),
    }
}

/// Adds a field to those of a header. The same again changes nothing; another value is a contradiction.
pub(crate) fn add_field(
    path: &Path,
    fields: &mut BTreeMap<String, String>,
    (name, value): (&str, &str),
) -> Result<(), VolumeError> {
    match fields.insert(name.to_owned(), value.to_owned()) {
        Some(earlier) if earlier != value => {
            Err(wrong(path, name, value, &format!("the same value each time (`{earlier}` before)")))
        }
        _ => Ok(()),
    }
}

/// A [`VolumeError::Header`] for a field of a text header.
pub(crate) fn wrong(path: &Path, field: &str, given: &str, expected: &str) -> VolumeError {
    VolumeError::header(path, field, format!("`{given}`"), expected)
}

/// Parses exactly `N` numbers separated by white space or commas.
pub(crate) fn numbers<const N: usize>(path: &Path, field: &str, text: &str) -> Result<[f64; N], VolumeError> {
    let mut out = [0.0; N];
    let mut words = text.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty());
    for slot in &mut out {
        let word = words.next().and_then(|w| w.parse::<f64>().ok());
        *slot = word.ok_or_else(|| wrong(path, field, text, &format!("{N} numbers")))?;
    }
    match words.next() {
        None => Ok(out),
        Some(_) => Err(wrong(path, field, text, &format!("{N} numbers"))),
    }
}

/// Parses exactly `count` sizes.
pub(crate) fn all_sizes(
    path: &Path,
    field: &str,
    text: &str,
    count: usize,
) -> Result<Vec<usize>, VolumeError> {
    let parsed: Option<Vec<usize>> =
        text.split_whitespace().map(|word| word.parse().ok().filter(|n| *n > 0)).collect();
    let expected = format!("{count} positive whole numbers");
    parsed.filter(|sizes| sizes.len() == count).ok_or_else(|| wrong(path, field, text, &expected))
}

/// Metres per unit of length, by its name or symbol.
pub(crate) fn unit_of_length(name: &str) -> Option<(f64, &'static str)> {
    match name.trim().to_lowercase().as_str() {
        "m" | "meter" | "metre" | "meters" | "metres" => Some((1.0, "m")),
        "cm" | "centimeter" | "centimetre" | "centimeters" => Some((1e-2, "cm")),
        "mm" | "millimeter" | "millimetre" | "millimeters" | "millimetres" => Some((1e-3, "mm")),
        "um" | "µm" | "μm" | "micron" | "microns" | "micrometer" | "micrometers" => Some((1e-6, "um")),
        _ => None,
    }
}

/// Reads `count` numbers written as text, from byte `offset` on.
pub(crate) fn read_ascii(
    path: &Path,
    offset: u64,
    count: usize,
    sink: &mut HuSink,
) -> Result<(), VolumeError> {
    let (mut reader, length) = open_stream(path, offset, Codec::Raw)?;
    // The shortest text of n numbers has n digits and n − 1 separators.
    crate::input::check_length(path, length, 2 * count as u64 - 1)?;
    let mut buffer = vec![0_u8; 1 << 16];
    let mut word = Vec::new();
    let mut found = 0_usize;
    let wrong_count =
        |given: String| VolumeError::header(path, "voxel data", given, format!("{count} numbers"));
    loop {
        let got = read_full(path, Codec::Raw.name(), reader.as_mut(), &mut buffer)?;
        // A separator after the end terminates the last word.
        let end: &[u8] = if got == 0 { b" " } else { &[] };
        for &byte in buffer[..got].iter().chain(end) {
            if !(byte.is_ascii_whitespace() || byte == b',') {
                word.push(byte);
                if word.len() > 64 {
                    return Err(wrong(
                        path,
                        "voxel data",
                        &String::from_utf8_lossy(&word),
                        "numbers as text",
                    ));
                }
            } else if found < count && !word.is_empty() {
                let text = String::from_utf8_lossy(&word);
                let value = text.parse::<f64>();
                sink.push(
                    value.map_err(|_| wrong(path, "voxel data", &text, "numbers as text"))?,
                    Scale::IDENTITY,
                );
                found += 1;
                word.clear();
            } else if !word.is_empty() {
                return Err(wrong_count("more".into()));
            }
        }
        if got == 0 {
            return if found == count { Ok(()) } else { Err(wrong_count(format!("{found} numbers"))) };
        }
    }
}
