//! The fields of an NRRD header.

use crate::data_files::is_list;
use crate::error::VolumeError;
use crate::input::{self, Codec, DataFiles};
use crate::scalar::{Endian, Scalar};
use crate::text_header::{MAX_HEADER_BYTES, add_field, text_of, wrong};
use std::collections::BTreeMap;
use std::path::Path;

/// Fields by lower-case name, and the header's length in bytes (the voxels of an attached file follow).
pub(super) struct Header<'a> {
    pub path: &'a Path,
    pub files: DataFiles,
    fields: BTreeMap<String, String>,
    /// `key:=value` pairs, by key as written.
    pub pairs: BTreeMap<String, String>,
    /// The lines after `data file: LIST`.
    pub list: Vec<String>,
    pub length: u64,
}

impl<'a> Header<'a> {
    pub fn read(path: &'a Path, files: DataFiles) -> Result<Self, VolumeError> {
        let bytes = input::head(path, 0, Codec::Raw, MAX_HEADER_BYTES)?;
        let mut header = Self {
            path,
            files,
            fields: BTreeMap::new(),
            pairs: BTreeMap::new(),
            list: Vec::new(),
            length: 0,
        };
        let mut rest = bytes.as_slice();
        let mut first = true;
        while !rest.is_empty() {
            let end = rest.iter().position(|b| *b == b'\n');
            let (line, next) = match end {
                Some(end) => (&rest[..end], &rest[end + 1..]),
                None => (rest, &rest[rest.len()..]),
            };
            rest = next;
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            if line.is_empty() {
                break;
            }
            let text = &*text_of(line);
            if first {
                let known = ["NRRD0001", "NRRD0002", "NRRD0003", "NRRD0004", "NRRD0005"];
                if !known.contains(&text.trim_end()) {
                    return Err(wrong(path, "magic", text, "NRRD0001 to NRRD0005"));
                }
                first = false;
            } else {
                header.take(text)?;
            }
        }
        header.length = (bytes.len() - rest.len()) as u64;
        Ok(header)
    }

    /// Parses one line after the magic.
    fn take(&mut self, line: &str) -> Result<(), VolumeError> {
        if line.starts_with('#') {
            return Ok(());
        }
        if self.is_list() {
            self.list.push(line.trim().to_owned());
            return Ok(());
        }
        if let Some((key, value)) = line.split_once(":=") {
            self.pairs.insert(key.to_owned(), value.to_owned());
            return Ok(());
        }
        let Some((name, value)) = line.split_once(": ").or_else(|| line.split_once(':')) else {
            return Ok(());
        };
        let name = canonical(&name.trim().to_lowercase());
        add_field(self.path, &mut self.fields, (&name, value.trim()))
    }

    /// Whether an earlier line was `data file: LIST`: every line after it is a file name.
    pub fn is_list(&self) -> bool {
        self.get("data file").is_some_and(is_list)
    }

    pub fn get(&self, field: &str) -> Option<&str> {
        self.fields.get(field).map(String::as_str)
    }

    pub fn require(&self, field: &str, expected: &str) -> Result<&str, VolumeError> {
        self.get(field).ok_or_else(|| wrong(self.path, field, "", expected))
    }

    pub fn unsupported(&self, field: &str, given: &str, expected: &str) -> VolumeError {
        VolumeError::unsupported(self.path, field, format!("`{given}`"), expected)
    }

    pub fn scalar(&self) -> Result<Scalar, VolumeError> {
        let name = self.require("type", "an integer or float type")?.to_lowercase();
        Ok(match name.as_str() {
            "signed char" | "int8" | "int8_t" => Scalar::I8,
            "uchar" | "unsigned char" | "uint8" | "uint8_t" => Scalar::U8,
            "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => Scalar::I16,
            "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => Scalar::U16,
            "int" | "signed int" | "int32" | "int32_t" => Scalar::I32,
            "uint" | "unsigned int" | "uint32" | "uint32_t" => Scalar::U32,
            "longlong"
            | "long long"
            | "long long int"
            | "signed long long"
            | "signed long long int"
            | "int64"
            | "int64_t" => Scalar::I64,
            "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => {
                Scalar::U64
            }
            "float" => Scalar::F32,
            "double" => Scalar::F64,
            _ => return Err(self.unsupported("type", &name, "an integer of 8 to 64 bits, float or double")),
        })
    }

    pub fn endian(&self, scalar: Scalar) -> Result<Endian, VolumeError> {
        let given = self.get("endian").map(str::to_lowercase);
        match (given.as_deref(), scalar.size()) {
            (Some("little"), _) => Ok(Endian::Little),
            (Some("big"), _) => Ok(Endian::Big),
            (None, 1) => Ok(Endian::Little),
            (given, _) => Err(wrong(self.path, "endian", given.unwrap_or(""), "little or big")),
        }
    }

    /// An integer, or 0 if the field is absent.
    pub fn whole(&self, field: &str, least: i64) -> Result<i64, VolumeError> {
        let Some(text) = self.get(field) else { return Ok(0) };
        let expected = format!("a whole number, at least {least}");
        let value = text.parse::<i64>().ok().filter(|n| *n >= least);
        value.ok_or_else(|| wrong(self.path, field, text, &expected))
    }
}

/// The spelling of the format definition, for names with two spellings.
fn canonical(name: &str) -> String {
    match name {
        "datafile" => "data file",
        "lineskip" => "line skip",
        "byteskip" => "byte skip",
        "axismins" => "axis mins",
        "centerings" => "centers",
        other => other,
    }
    .into()
}
