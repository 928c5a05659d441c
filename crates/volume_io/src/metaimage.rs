//! MetaImage files: .mha, and .mhd with a data file; raw, zlib-compressed or text.
//!
//! Source: MetaIO documentation (itk.org/Wiki/MetaIO/Documentation) and ITK's `MetaImageIO`: world LPS; rows
//! of `TransformMatrix` are the axis directions. There is no maintained crate for this format.

use crate::data_files::{DataFile, is_list, named, read_each};
use crate::error::{Field, VolumeError};
use crate::input::{self, Codec, DataFiles};
use crate::options::ReadOptions;
use crate::scalar::{Endian, HuSink, Layout, Scalar, Scale};
use crate::text_header::{
    MAX_HEADER_BYTES, add_field, all_sizes, numbers, read_ascii, text_of, unit_of_length, wrong,
};
use crate::volume::{GeometryFields, StatedGeometry, VolumeInfo, placed, placement, voxel_count};
use std::collections::BTreeMap;
use std::path::Path;
use voxel_grid::{Placement, Volume};

struct Header<'a> {
    path: &'a Path,
    files: DataFiles,
    fields: BTreeMap<String, String>,
    /// The lines after `ElementDataFile = LIST`.
    list: Vec<String>,
    /// Length of the header; local data follow.
    length: u64,
}

/// Whether voxels in the header's own file are compressed; `None` if they are in other files.
pub(crate) fn is_local_compressed(path: &Path, options: &ReadOptions) -> Result<Option<bool>, VolumeError> {
    let header = Header::read(path, options.data_files)?;
    let is_local = header.data_files()?.iter().all(|file| file.path == path);
    let is_compressed = header.flag("CompressedData")?.unwrap_or(false);
    Ok(is_local.then_some(is_compressed))
}

/// Reads the volume whose header is at `path`.
pub(crate) fn read(path: &Path, options: &ReadOptions) -> Result<(Volume, VolumeInfo), VolumeError> {
    let header = Header::read(path, options.data_files)?;
    let dims = header.dimensions()?;
    let count = voxel_count(path, "DimSize", dims)?;
    let mut notes = Vec::new();
    let (unit_m, unit_name) = header.unit()?;
    let geometry = header.geometry(unit_m, &mut notes)?;
    let scalar = header.scalar()?;
    header.refuse_intensity_function()?;
    let files = header.data_files()?;
    let mut sink = options.sink(path)?;
    let field = "ElementDataFile";
    let (encoding, stored_as) = if header.flag("BinaryData")?.unwrap_or(true) {
        let endian = header.endian()?;
        let layout = Layout { scalar, endian, scale: Scale::IDENTITY };
        let mut codec = Codec::Raw;
        read_each(path, field, &files, count, |file, part| {
            codec = header.read_binary(file, layout, part, &mut sink, &mut notes)?;
            Ok(())
        })?;
        (codec.name(), scalar.describe(endian))
    } else {
        read_each(path, field, &files, count, |file, part| {
            read_ascii(&file.path, file.start, part, &mut sink)
        })?;
        ("ascii", scalar.name().into())
    };
    let mut hu = sink.finish(&mut notes);
    options.keep_label(path, &mut hu)?;
    let volume = placed(path, dims, geometry, hu)?;
    let kind = if files.iter().any(|file| file.path == path) { "local" } else { "detached" };
    let format = format!("MetaImage ({encoding}, {kind})");
    let info = VolumeInfo::new(&volume, format, stored_as, unit_name, notes);
    Ok((volume, info))
}

impl<'a> Header<'a> {
    fn read(path: &'a Path, files: DataFiles) -> Result<Self, VolumeError> {
        let bytes = input::head(path, 0, Codec::Raw, MAX_HEADER_BYTES)?;
        let mut fields = BTreeMap::new();
        let mut at = 0;
        // `ElementDataFile` is by definition the last field; everything after its line is data.
        while at < bytes.len() && !fields.contains_key("ElementDataFile") {
            let end = bytes[at..].iter().position(|b| *b == b'\n').map_or(bytes.len(), |n| at + n);
            let line = bytes[at..end].strip_suffix(b"\r").unwrap_or(&bytes[at..end]);
            at = (end + 1).min(bytes.len());
            let text = &*text_of(line);
            if text.trim().is_empty() {
                continue;
            }
            let Some((name, value)) = text.split_once('=') else {
                return Err(wrong(path, "header", text, "lines of the form `name = value`"));
            };
            add_field(path, &mut fields, (name.trim(), value.trim()))?;
        }
        let mut list = Vec::new();
        if fields.get("ElementDataFile").is_some_and(|name| is_list(name)) {
            let names = String::from_utf8_lossy(&bytes[at..]);
            list.extend(names.lines().map(|line| line.trim().to_owned()));
        }
        Ok(Self { path, files, fields, list, length: at as u64 })
    }

    fn get(&self, names: &[&'static str]) -> Option<(&'static str, &str)> {
        names.iter().find_map(|name| self.fields.get(*name).map(|value| (*name, value.as_str())))
    }

    fn require(&self, names: &[&'static str], expected: &str) -> Result<(&'static str, &str), VolumeError> {
        self.get(names).ok_or_else(|| wrong(self.path, names.first().copied().unwrap_or(""), "", expected))
    }

    fn unsupported(&self, field: &str, given: &str, expected: &str) -> VolumeError {
        VolumeError::unsupported(self.path, field, format!("`{given}`"), expected)
    }

    /// A boolean field; `None` if the header lacks it.
    fn flag(&self, name: &'static str) -> Result<Option<bool>, VolumeError> {
        match self.get(&[name]) {
            None => Ok(None),
            Some((_, value)) => match value.to_lowercase().as_str() {
                "true" | "1" => Ok(Some(true)),
                "false" | "0" => Ok(Some(false)),
                _ => Err(wrong(self.path, name, value, "True or False")),
            },
        }
    }

    fn dimensions(&self) -> Result<[usize; 3], VolumeError> {
        if let Some((field, kind)) = self.get(&["ObjectType"]).filter(|(_, kind)| *kind != "Image") {
            return Err(self.unsupported(field, kind, "Image"));
        }
        let (_, rank) = self.require(&["NDims"], "3")?;
        let (_, given) = self.require(&["DimSize"], "three positive whole numbers")?;
        if rank.parse::<u8>().is_err() {
            return Err(wrong(self.path, "NDims", rank, "3"));
        }
        // A fourth axis may hold a single time point.
        let axes = if rank == "4" { 4 } else { 3 };
        let sizes = all_sizes(self.path, "DimSize", given, axes);
        let not_three = || {
            VolumeError::NotThreeDimensional(Field::new(
                self.path,
                "NDims",
                format!("{rank} with DimSize {given}"),
            ))
        };
        if rank != "3" && rank != "4" {
            return Err(not_three());
        }
        if let Some((field, channels)) = self.get(&["ElementNumberOfChannels"]).filter(|(_, n)| *n != "1") {
            return Err(VolumeError::NotScalar(Field::new(self.path, field, format!("{channels} channels"))));
        }
        match sizes?.as_slice() {
            [i, j, k] | [i, j, k, 1] => Ok([*i, *j, *k]),
            _ => Err(not_three()),
        }
    }

    fn scalar(&self) -> Result<Scalar, VolumeError> {
        let (field, name) = self.require(&["ElementType"], "MET_SHORT or another scalar type")?;
        Ok(match name {
            "MET_CHAR" => Scalar::I8,
            "MET_UCHAR" => Scalar::U8,
            "MET_SHORT" => Scalar::I16,
            "MET_USHORT" => Scalar::U16,
            // MetaIO defines long as four bytes (metaTypes.h), whatever machine wrote the file.
            "MET_INT" | "MET_LONG" => Scalar::I32,
            "MET_UINT" | "MET_ULONG" => Scalar::U32,
            "MET_LONG_LONG" => Scalar::I64,
            "MET_ULONG_LONG" => Scalar::U64,
            "MET_FLOAT" => Scalar::F32,
            "MET_DOUBLE" => Scalar::F64,
            _ if name.ends_with("_ARRAY") => {
                return Err(VolumeError::NotScalar(Field::new(self.path, field, name)));
            }
            _ => {
                return Err(self.unsupported(
                    field,
                    name,
                    "an integer of 8 to 64 bits, MET_FLOAT or MET_DOUBLE",
                ));
            }
        })
    }

    fn endian(&self) -> Result<Endian, VolumeError> {
        let is_set = |name| Ok::<bool, VolumeError>(self.flag(name)?.unwrap_or(false));
        let msb = is_set("ElementByteOrderMSB")? || is_set("BinaryDataByteOrderMSB")?;
        Ok(if msb { Endian::Big } else { Endian::Little })
    }

    fn unit(&self) -> Result<(f64, String), VolumeError> {
        match self.get(&["DistanceUnits"]) {
            None | Some((_, "?")) => Ok((1e-3, "mm (assumed: not stated in the file)".into())),
            Some((field, text)) => unit_of_length(text)
                .map(|(unit_m, name)| (unit_m, name.to_string()))
                .ok_or_else(|| self.unsupported(field, text, "m, cm, mm or um")),
        }
    }

    fn geometry(&self, unit_m: f64, notes: &mut Vec<String>) -> Result<Placement, VolumeError> {
        let names =
            GeometryFields { spacing: "ElementSpacing", direction: "TransformMatrix", origin: "Offset" };
        let spacing = match self.get(&["ElementSpacing", "ElementSize"]) {
            Some((field, text)) => self.of_space(field, text)?,
            // MetaIO's default.
            None => {
                notes.push(format!("no ElementSpacing given; assuming voxels of {} mm", unit_m * 1e3));
                [1.0; 3]
            }
        };
        let origin = match self.get(&["Offset", "Origin", "Position"]) {
            Some((field, text)) => self.of_space(field, text)?,
            None => {
                notes.push("no origin given; assuming (0, 0, 0)".into());
                [0.0; 3]
            }
        };
        let m = match self.get(&["TransformMatrix", "Rotation", "Orientation"]) {
            Some((field, text)) if self.has_time() => {
                let m = numbers::<16>(self.path, field, text)?;
                [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]
            }
            Some((field, text)) => numbers::<9>(self.path, field, text)?,
            None => {
                notes.push("no axis directions given; assuming left, posterior, superior".into());
                [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            }
        };
        let axes = [[m[0], m[1], m[2]], [m[3], m[4], m[5]], [m[6], m[7], m[8]]];
        let (spacing_m, origin_m) = (spacing.map(|s| s * unit_m), origin.map(|o| o * unit_m));
        placement(self.path, names, StatedGeometry { spacing_m, origin_m, axes }, notes)
    }

    /// Whether there is a fourth axis, for which [`Self::dimensions`] has checked that its size is 1.
    fn has_time(&self) -> bool {
        self.get(&["NDims"]).is_some_and(|(_, rank)| rank == "4")
    }

    /// The spatial entries of a field with one number per axis.
    fn of_space(&self, field: &str, text: &str) -> Result<[f64; 3], VolumeError> {
        if self.has_time() {
            return numbers::<4>(self.path, field, text).map(|[x, y, z, _]| [x, y, z]);
        }
        numbers::<3>(self.path, field, text)
    }

    /// Refuses intensity functions: some readers apply them, others (ITK) ignore them, so the values are
    /// ambiguous.
    fn refuse_intensity_function(&self) -> Result<(), VolumeError> {
        for (name, neutral) in
            [("ElementToIntensityFunctionSlope", 1.0), ("ElementToIntensityFunctionOffset", 0.0)]
        {
            if let Some((field, text)) = self.get(&[name])
                && text.parse::<f64>().ok() != Some(neutral)
            {
                return Err(self.unsupported(
                    field,
                    text,
                    &format!("{neutral}; store Hounsfield units directly"),
                ));
            }
        }
        Ok(())
    }

    /// The data files in order; the header's own file for local voxels.
    fn data_files(&self) -> Result<Vec<DataFile>, VolumeError> {
        let (field, name) = self.require(&["ElementDataFile"], "LOCAL or a file name")?;
        match name {
            "LOCAL" | "Local" | "local" => {
                Ok(vec![DataFile { path: self.path.to_path_buf(), start: self.length }])
            }
            "" => Err(wrong(self.path, field, name, "LOCAL or a file name")),
            _ => named(self.path, (field, name), &self.list, self.files),
        }
    }

    fn read_binary(
        &self,
        file: &DataFile,
        layout: Layout,
        count: usize,
        sink: &mut HuSink,
        notes: &mut Vec<String>,
    ) -> Result<Codec, VolumeError> {
        let (path, start) = (file.path.as_path(), file.start);
        let codec = if self.flag("CompressedData")?.unwrap_or(false) {
            // MetaIO writes zlib streams but reads gzip as well.
            let magic = input::head(path, start, Codec::Raw, 2)?;
            if magic == [0x1f, 0x8b] { Codec::Gzip } else { Codec::Zlib }
        } else {
            Codec::Raw
        };
        let header_size = match self.get(&["HeaderSize"]) {
            None => 0,
            Some((field, text)) => text
                .parse::<i64>()
                .ok()
                .filter(|n| *n >= -1)
                .ok_or_else(|| wrong(self.path, field, text, "-1 or a number of bytes"))?,
        };
        if header_size != 0 && codec != Codec::Raw {
            return Err(self.unsupported("HeaderSize", &header_size.to_string(), "0 for compressed data"));
        }
        let offset = match u64::try_from(header_size) {
            Ok(skip) => start.saturating_add(skip),
            // −1: the voxels are the last bytes of the file.
            Err(_) => {
                let ((_, length), needed) = (input::open(path)?, layout.byte_count(count));
                input::check_length(path, length, needed)?;
                length - needed
            }
        };
        layout.read_file((path, offset, codec), 0, ("DimSize", count), sink, notes)?;
        Ok(codec)
    }
}
