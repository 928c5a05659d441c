//! NRRD files: attached (.nrrd) and detached (.nhdr), raw, gzip, bzip2 or text.
//!
//! Source: "Definition of NRRD File Format", teem.sourceforge.net/nrrd/format.html. No well-kept crate reads this format.

use crate::error::VolumeError;
use crate::input::{self, Codec, DataFiles};
use crate::scalar::{Endian, HuSink, Layout, Scalar, Scale};
use crate::text_header::{MAX_HEADER_BYTES, numbers, read_ascii, sizes, unit_of_length, wrong};
use crate::volume::{GeometryFields, Volume, VolumeInfo, columns, norm, placement, voxel_count};
use std::collections::BTreeMap;
use std::path::Path;
use voxel_grid::Placement;

/// Fields by lower-case name, and the header's length in bytes (the voxels of an attached file follow).
struct Header<'a> {
    path: &'a Path,
    files: DataFiles,
    fields: BTreeMap<String, String>,
    length: u64,
}

/// Directions of the spatial axes, as signs that convert the file's space to LPS.
struct Space {
    to_lps: [f64; 3],
    name: String,
}

/// Reads the volume whose header is at `path`.
pub(crate) fn read(path: &Path, files: DataFiles) -> Result<(Volume, VolumeInfo), VolumeError> {
    let header = Header::read(path, files)?;
    let dims = header.dimensions()?;
    let count = voxel_count(path, "sizes", dims)?;
    let mut notes = Vec::new();
    let (unit_m, unit_name) = header.unit()?;
    let geometry = header.geometry(unit_m, &mut notes)?;
    let scalar = header.scalar()?;
    let encoding = header.require("encoding", "raw, gzip, bzip2 or ascii")?.to_lowercase();
    let mut sink = HuSink::default();
    let stored_as = match encoding.as_str() {
        "ascii" | "text" | "txt" => {
            let (data_path, offset) = header.data_start()?;
            read_ascii(&data_path, offset, count, &mut sink)?;
            scalar.name().into()
        }
        _ => {
            let codec = match encoding.as_str() {
                "raw" => Codec::Raw,
                "gzip" | "gz" => Codec::Gzip,
                "bzip2" | "bz2" => Codec::Bzip2,
                other => return Err(header.unsupported("encoding", other, "raw, gzip, bzip2 or ascii")),
            };
            let layout = Layout { scalar, endian: header.endian(scalar)?, scale: Scale::IDENTITY };
            header.read_binary(layout, codec, count, (&mut sink, &mut notes))?;
            layout.scalar.describe(layout.endian)
        }
    };
    let hu = sink.finish(&mut notes);
    let volume = Volume::placed(dims, &geometry, hu);
    let kind = if header.get("data file").is_some() { ", detached" } else { "" };
    let format = format!("NRRD ({encoding}{kind})");
    let info = VolumeInfo::new(&volume, format, stored_as, unit_name, notes);
    Ok((volume, info))
}

impl<'a> Header<'a> {
    fn read(path: &'a Path, files: DataFiles) -> Result<Self, VolumeError> {
        let bytes = input::head(path, 0, Codec::Raw, MAX_HEADER_BYTES)?;
        let mut fields = BTreeMap::new();
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
            let text = std::str::from_utf8(line).map_err(|_| {
                wrong(path, "header", &String::from_utf8_lossy(line), "text lines, then an empty line")
            })?;
            if first {
                let known = ["NRRD0001", "NRRD0002", "NRRD0003", "NRRD0004", "NRRD0005"];
                if !known.contains(&text.trim_end()) {
                    return Err(wrong(path, "magic", text, "NRRD0001 to NRRD0005"));
                }
                first = false;
                continue;
            }
            // `key:=value` pairs and comments carry no geometry.
            let field = text.split_once(": ").or_else(|| text.split_once(':'));
            let Some((name, value)) =
                field.filter(|(name, value)| !name.contains(":=") && !value.starts_with('='))
            else {
                continue;
            };
            if text.starts_with('#') {
                continue;
            }
            let name = canonical(&name.trim().to_lowercase());
            if fields.insert(name.clone(), value.trim().to_string()).is_some() {
                return Err(wrong(path, &name, value, "each field once"));
            }
        }
        let length = (bytes.len() - rest.len()) as u64;
        Ok(Self { path, files, fields, length })
    }

    fn get(&self, field: &str) -> Option<&str> {
        self.fields.get(field).map(String::as_str)
    }

    fn require(&self, field: &str, expected: &str) -> Result<&str, VolumeError> {
        self.get(field).ok_or_else(|| wrong(self.path, field, "", expected))
    }

    fn unsupported(&self, field: &str, given: &str, expected: &str) -> VolumeError {
        VolumeError::Unsupported {
            path: self.path.into(),
            field: field.into(),
            given: format!("`{given}`"),
            expected: expected.into(),
        }
    }

    /// The sizes of three spatial axes, or an error that says what the file has instead.
    fn dimensions(&self) -> Result<[usize; 3], VolumeError> {
        let rank = self.require("dimension", "3")?;
        let given_sizes = self.require("sizes", "three positive whole numbers")?;
        if rank.parse::<u8>().is_err() {
            return Err(wrong(self.path, "dimension", rank, "3"));
        }
        if let Some(kinds) = self.get("kinds") {
            let scalar_kinds = ["domain", "space", "time", "none", "???"];
            let other =
                kinds.split_whitespace().find(|kind| !scalar_kinds.contains(&kind.to_lowercase().as_str()));
            if let Some(kind) = other {
                return Err(VolumeError::NotScalar {
                    path: self.path.into(),
                    field: "kinds".into(),
                    given: format!("`{kind}` in `{kinds}`"),
                });
            }
        }
        if rank != "3" {
            return Err(VolumeError::NotThreeDimensional {
                path: self.path.into(),
                field: "dimension".into(),
                given: format!("{rank} with sizes {given_sizes}"),
            });
        }
        sizes(self.path, "sizes", given_sizes)
    }

    fn scalar(&self) -> Result<Scalar, VolumeError> {
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

    fn endian(&self, scalar: Scalar) -> Result<Endian, VolumeError> {
        match (self.get("endian"), scalar.size()) {
            (Some("little"), _) => Ok(Endian::Little),
            (Some("big"), _) => Ok(Endian::Big),
            (None, 1) => Ok(Endian::Little),
            (given, _) => Err(wrong(self.path, "endian", given.unwrap_or(""), "little or big")),
        }
    }

    /// Metres per unit of length; all three axes must agree.
    fn unit(&self) -> Result<(f64, String), VolumeError> {
        // `space units` holds one quoted name per axis; `units` is its counterpart in files without a space.
        let Some((field, text)) = ["space units", "units"].iter().find_map(|f| self.get(f).map(|t| (*f, t)))
        else {
            return Ok((1e-3, "mm (assumed: the file states none)".into()));
        };
        let names: Vec<&str> = if text.contains('"') {
            text.split('"').skip(1).step_by(2).collect()
        } else {
            text.split_whitespace().collect()
        };
        let first = names.first().copied().unwrap_or("");
        if names.iter().all(|name| name.trim().is_empty()) {
            return Ok((1e-3, "mm (assumed: the file states none)".into()));
        }
        let expected = "the same unit of length for every axis: m, cm, mm or um";
        if names.iter().any(|name| *name != first) {
            return Err(self.unsupported(field, text, expected));
        }
        let (unit_m, name) = unit_of_length(first).ok_or_else(|| self.unsupported(field, text, expected))?;
        Ok((unit_m, name.into()))
    }

    fn space(&self, notes: &mut Vec<String>) -> Result<Space, VolumeError> {
        let Some(name) = self.get("space") else {
            if let Some(rank) = self.get("space dimension").filter(|rank| *rank != "3") {
                return Err(wrong(self.path, "space dimension", rank, "3"));
            }
            notes.push("no space is named: left, posterior, superior is assumed".into());
            return Ok(Space { to_lps: [1.0; 3], name: "none".into() });
        };
        let lower = name.to_lowercase();
        let letters = match lower.as_str() {
            "right-anterior-superior" | "ras" => ["right", "anterior", "superior"],
            "left-anterior-superior" | "las" => ["left", "anterior", "superior"],
            "left-posterior-superior" | "lps" => ["left", "posterior", "superior"],
            _ => {
                // Any other combination of the six directions in patient order (x, y, z) is unambiguous too.
                let words: Vec<&str> = lower.split('-').collect();
                let valid = matches!(
                    words.as_slice(),
                    ["right" | "left", "anterior" | "posterior", "superior" | "inferior"]
                );
                if !valid {
                    let expected =
                        "left-posterior-superior, right-anterior-superior or left-anterior-superior";
                    return Err(self.unsupported("space", name, expected));
                }
                [words[0], words[1], words[2]].map(|w| match w {
                    "left" => "left",
                    "right" => "right",
                    "anterior" => "anterior",
                    "posterior" => "posterior",
                    "superior" => "superior",
                    _ => "inferior",
                })
            }
        };
        let to_lps = letters.map(|l| if matches!(l, "right" | "anterior" | "inferior") { -1.0 } else { 1.0 });
        Ok(Space { to_lps, name: lower })
    }

    fn geometry(&self, unit_m: f64, notes: &mut Vec<String>) -> Result<Placement, VolumeError> {
        let space = self.space(notes)?;
        let origin = match self.get("space origin") {
            Some(text) => self.vector("space origin", text)?,
            None => self.axis_minima(notes)?,
        };
        let flip = |v: [f64; 3]| [0, 1, 2].map(|i| space.to_lps[i] * v[i]);
        let origin_m = flip(origin).map(|o| o * unit_m);
        let names =
            GeometryFields { spacing: "spacings", direction: "space directions", origin: "space origin" };
        if let Some(text) = self.get("space directions") {
            if self.get("spacings").is_some_and(|s| !s.to_lowercase().split_whitespace().all(|w| w == "nan"))
            {
                return Err(wrong(
                    self.path,
                    "spacings",
                    self.get("spacings").unwrap_or(""),
                    "absent beside `space directions`",
                ));
            }
            let mut axes = [[0.0; 3]; 3];
            let vectors = split_vectors(text);
            if vectors.len() != 3 {
                return Err(wrong(
                    self.path,
                    "space directions",
                    text,
                    "three vectors such as (1,0,0) (0,1,0) (0,0,1)",
                ));
            }
            for (axis, vector) in axes.iter_mut().zip(&vectors) {
                *axis = flip(self.vector("space directions", vector)?);
            }
            if axes.iter().any(|a| !norm(*a).is_finite() || norm(*a) == 0.0) {
                return Err(VolumeError::SingularDirection {
                    path: self.path.into(),
                    field: "space directions".into(),
                    given: text.into(),
                });
            }
            let names = GeometryFields { spacing: "space directions", ..names };
            return placement(self.path, names, axes.map(|a| norm(a) * unit_m), origin_m, axes);
        }
        let spacing = match self.get("spacings") {
            Some(text) => numbers::<3>(self.path, "spacings", text)?,
            None => {
                return Err(wrong(
                    self.path,
                    "space directions",
                    "",
                    "`space directions` or `spacings`: the voxel size",
                ));
            }
        };
        if space.name != "none" {
            notes.push("no space directions: the axes are assumed to follow the space".into());
        }
        let axes =
            columns([[space.to_lps[0], 0.0, 0.0], [0.0, space.to_lps[1], 0.0], [0.0, 0.0, space.to_lps[2]]]);
        placement(self.path, names, spacing.map(|s| s * unit_m), origin_m, axes)
    }

    /// Origin of a file without a space: `axis mins`, or zero.
    fn axis_minima(&self, notes: &mut Vec<String>) -> Result<[f64; 3], VolumeError> {
        match self.get("axis mins") {
            Some(text) if !text.to_lowercase().contains("nan") => {
                notes.push("the origin is taken from `axis mins`, as the centre of the first voxel".into());
                numbers::<3>(self.path, "axis mins", text)
            }
            _ => {
                notes.push("no origin is given: (0, 0, 0) is assumed".into());
                Ok([0.0; 3])
            }
        }
    }

    fn vector(&self, field: &str, text: &str) -> Result<[f64; 3], VolumeError> {
        let inner = text.trim().strip_prefix('(').and_then(|t| t.strip_suffix(')'));
        let inner = inner.ok_or_else(|| wrong(self.path, field, text, "a vector such as (1,0,0)"))?;
        numbers::<3>(self.path, field, inner)
    }

    fn whole(&self, field: &str, least: i64) -> Result<i64, VolumeError> {
        let Some(text) = self.get(field) else { return Ok(0) };
        let expected = format!("a whole number, at least {least}");
        let value = text.parse::<i64>().ok().filter(|n| *n >= least);
        value.ok_or_else(|| wrong(self.path, field, text, &expected))
    }

    /// The file that holds the voxels, and the byte at which they start after `line skip`.
    fn data_start(&self) -> Result<(std::path::PathBuf, u64), VolumeError> {
        let lines = self.whole("line skip", 0)?;
        let (path, start) = match self.get("data file") {
            None => (self.path.to_path_buf(), self.length),
            Some(name) if name.to_uppercase().starts_with("LIST") || name.contains('%') => {
                return Err(self.unsupported("data file", name, "one data file; join the slices first"));
            }
            Some(name) => (input::data_file(self.path, "data file", name, self.files)?, 0),
        };
        if lines == 0 {
            return Ok((path, start));
        }
        let (mut reader, _) = input::open_stream(&path, start, Codec::Raw)?;
        let mut buffer = vec![0_u8; 1 << 16];
        let (mut left, mut offset) = (lines, start);
        while left > 0 {
            let got = input::read_full(&path, Codec::Raw.name(), reader.as_mut(), &mut buffer)?;
            if got == 0 {
                let given = self.get("line skip").unwrap_or("");
                return Err(wrong(self.path, "line skip", given, "no more lines than the data file has"));
            }
            for &byte in &buffer[..got] {
                if left == 0 {
                    break;
                }
                offset += 1;
                left -= i64::from(byte == b'\n');
            }
        }
        Ok((path, offset))
    }

    fn read_binary(
        &self,
        layout: Layout,
        codec: Codec,
        count: usize,
        (sink, notes): (&mut HuSink, &mut Vec<String>),
    ) -> Result<(), VolumeError> {
        let (path, start) = self.data_start()?;
        let needed = layout.byte_count(count);
        // −1: the voxels are the last bytes of the (decoded) data.
        let byte_skip = self.whole("byte skip", -1)?;
        let skip = match u64::try_from(byte_skip) {
            Ok(skip) => skip,
            Err(_) => {
                let length = decoded_length(&path, start, codec)?;
                input::check_length(&path, length, needed)?;
                length - needed
            }
        };
        let (mut reader, most_bytes) = input::open_stream(&path, start, codec)?;
        if codec == Codec::Bzip2 && most_bytes < skip.saturating_add(needed) {
            let given = format!("bzip2 data that would grow to {needed} bytes of voxels");
            let expected = "data that grow by a factor of at most 10000; store it as raw or gzip";
            return Err(VolumeError::Unsupported {
                path,
                field: "encoding".into(),
                given,
                expected: expected.into(),
            });
        }
        input::check_length(&path, most_bytes, skip.saturating_add(needed))?;
        input::skip(&path, codec.name(), reader.as_mut(), skip)?;
        layout.read(&path, codec.name(), reader.as_mut(), count, sink)?;
        let bytes = (skip.saturating_add(needed), most_bytes);
        input::check_end(&path, "sizes, byte skip", (codec, reader.as_mut()), bytes, notes)
    }
}

/// Length of a decoded stream; decodes it without keeping the data.
fn decoded_length(path: &Path, start: u64, codec: Codec) -> Result<u64, VolumeError> {
    let (mut reader, most_bytes) = input::open_stream(path, start, codec)?;
    if codec == Codec::Raw {
        return Ok(most_bytes);
    }
    // Twice the largest volume of the widest type: anything longer is a decompression bomb.
    let most_bytes = most_bytes.min(16 * voxel_grid::MAX_VOXELS as u64);
    let mut buffer = vec![0_u8; 1 << 16];
    let mut length = 0;
    loop {
        match input::read_full(path, codec.name(), reader.as_mut(), &mut buffer)? {
            0 => return Ok(length),
            got => length += got as u64,
        }
        if length > most_bytes {
            return Err(VolumeError::TooLarge {
                path: path.into(),
                field: "voxel data".into(),
                given: format!("more than {length} decoded bytes"),
                limit: voxel_grid::MAX_VOXELS,
            });
        }
    }
}

/// The spelling in the format definition, for names with two spellings.
fn canonical(name: &str) -> String {
    match name {
        "datafile" => "data file",
        "lineskip" => "line skip",
        "byteskip" => "byte skip",
        "axismins" => "axis mins",
        other => other,
    }
    .into()
}

/// Splits `(1,0,0) (0,1,0) none` into its entries; spaces inside parentheses do not split.
fn split_vectors(text: &str) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    let mut depth = 0_usize;
    let mut fresh = true;
    for c in text.chars() {
        if c.is_whitespace() && depth == 0 {
            fresh = true;
            continue;
        }
        depth = match c {
            '(' => depth + 1,
            ')' => depth.saturating_sub(1),
            _ => depth,
        };
        if fresh {
            out.push(String::new());
            fresh = false;
        }
        if let Some(entry) = out.last_mut() {
            entry.push(c);
        }
    }
    out
}
