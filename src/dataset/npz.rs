//! NumPy `.npz`: a zip archive of arrays in NumPy's format 1.0
//! (<https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>).

use std::io::Write as _;
use std::path::PathBuf;

use flate2::{Compression, Crc, write::DeflateEncoder};
use ipc_types::scene::LabelImage;
use serde_json::{Value, json};
use xray::Class;
use zerocopy::{Immutable, IntoBytes};

use super::{Dataset, DatasetFile, Run, Sample};
use crate::say::merged;

impl Dataset {
    pub(super) fn add_npz(&mut self, sample: &Sample, run: &Run) -> Result<Vec<DatasetFile>, String> {
        let part = &mut self.parts[run.part];
        let file = part.folder("").join(format!("{}.npz", run.name_of(sample)));
        let mut entry = merged(json!({"file": file}), sample.pose(run));
        if let Some(name) = part.name {
            entry["split"] = json!(name);
        }
        part.images.push(entry.to_string());
        Ok(vec![(file, archive(sample, &run.images)?)])
    }

    pub(super) fn end_npz(self) -> DatasetFile {
        let classes: serde_json::Map<String, Value> =
            Class::ALL.iter().map(|class| (class.name().to_owned(), json!(class.bit()))).collect();
        let frames: Vec<String> = self.parts.into_iter().flat_map(|part| part.images).collect();
        let text = format!(
            "{{\"bone_from_hu\":{},\n\"classes\":{},\n\"keypoints\":{},\n\"frames\":[\n{}\n]}}\n",
            self.bone_from_hu,
            Value::Object(classes),
            json!(self.keypoints),
            frames.join(",\n")
        );
        (PathBuf::from("dataset.json"), text.into_bytes())
    }
}

fn archive(sample: &Sample, images: &[LabelImage]) -> Result<Vec<u8>, String> {
    let labels = &sample.labels;
    let image = [labels.rows as usize, labels.columns as usize];
    let points: Vec<[f64; 3]> = labels.keypoints.iter().map(|p| [p.column, p.row, p.depth_m]).collect();
    let visibility: Vec<u8> = labels.keypoints.iter().map(|point| point.visibility.code()).collect();
    let (frame, camera, burr) = (&sample.frame, &sample.frame.projection, &sample.frame.t_world_burr);
    let mut zip = Zip::default();
    zip.array("image", "<u2", &image, &sample.greys[..])?;
    zip.array("mask", "|u1", &image, &labels.mask[..])?;
    for wanted in LabelImage::ALL.iter().filter(|wanted| images.contains(wanted)) {
        let (name, values) = match wanted {
            LabelImage::Anatomy => ("anatomy", &labels.anatomy),
            LabelImage::Metal => ("metal", &labels.metal),
            LabelImage::BoneM => ("bone_m", &labels.bone_m),
            LabelImage::TunnelM => ("tunnel_m", &labels.tunnel_m),
            LabelImage::ToolDepthM => ("tool_depth_m", &labels.tool_depth_m),
            LabelImage::BoneDepthM => ("bone_depth_m", &labels.bone_depth_m),
        };
        zip.array(name, "<f4", &image, &values[..])?;
    }
    zip.array("keypoints", "<f8", &[points.len(), 3], &points[..])?;
    zip.array("visibility", "|u1", &[visibility.len()], &visibility[..])?;
    zip.array("tick", "<u8", &[], &[frame.tick][..])?;
    zip.array("sim_time_s", "<f8", &[], &[frame.sim_time_s][..])?;
    zip.array("intrinsics", "<f8", &[3, 3], &camera.intrinsics[..])?;
    zip.array("rotation", "<f8", &[3, 3], &camera.rotation[..])?;
    zip.array("translation_m", "<f8", &[3], &camera.translation_m[..])?;
    zip.array("burr_position_m", "<f8", &[3], &burr.position_m[..])?;
    zip.array("burr_orientation_xyzw", "<f8", &[4], &burr.orientation_xyzw[..])?;
    zip.finish()
}

/// An in-memory zip archive of deflated files (PKWARE's APPNOTE 6.3.10, sections 4.3.7, 4.3.12, 4.3.16).
#[derive(Default)]
struct Zip {
    bytes: Vec<u8>,
    directory: Vec<u8>,
    files: u16,
}

impl Zip {
    /// Appends an array in C order; `dtype` in NumPy notation, shape `[]` for a scalar.
    fn array<T: IntoBytes + Immutable>(
        &mut self,
        name: &str,
        dtype: &str,
        shape: &[usize],
        values: &[T],
    ) -> Result<(), String> {
        let sides: String = shape.iter().map(|side| format!("{side},")).collect();
        let mut header = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({sides}), }}");
        // Pad the total length, with 10 bytes of magic, version and length, and the newline, to a multiple of
        // 64.
        let padding = (64 - (10 + header.len() + 1) % 64) % 64;
        header.extend(std::iter::repeat_n(' ', padding));
        header.push('\n');
        let mut file = b"\x93NUMPY\x01\x00".to_vec();
        file.extend((header.len() as u16).to_le_bytes());
        file.extend(header.as_bytes());
        file.extend(values.as_bytes());
        self.file(&format!("{name}.npy"), &file)
    }

    fn file(&mut self, name: &str, content: &[u8]) -> Result<(), String> {
        let mut crc = Crc::new();
        crc.update(content);
        let mut encoder = DeflateEncoder::new(Vec::new(), Compression::fast());
        let packed =
            encoder.write_all(content).and_then(|()| encoder.finish()).map_err(|cause| cause.to_string())?;
        let too_large = |_| format!("`{name}` exceeds the 4 GiB limit of a zip archive");
        let size = |bytes: usize| u32::try_from(bytes).map_err(too_large);
        // Fields shared by entry and directory: version 2.0, no flags, deflated, 1980-01-01 00:00.
        let mut facts = Vec::new();
        [20_u16, 0, 8, 0, 0x21].iter().for_each(|x| facts.extend(x.to_le_bytes()));
        let sizes = [crc.sum(), size(packed.len())?, size(content.len())?];
        sizes.iter().for_each(|x| facts.extend(x.to_le_bytes()));
        [name.len() as u16, 0].iter().for_each(|x| facts.extend(x.to_le_bytes()));
        let offset = size(self.bytes.len())?;
        self.directory.extend(b"PK\x01\x02\x14\x00");
        self.directory.extend(&facts);
        // No comment, disk 0, no attributes.
        self.directory.extend([0; 10]);
        self.directory.extend(offset.to_le_bytes());
        self.directory.extend(name.as_bytes());
        self.bytes.extend(b"PK\x03\x04");
        self.bytes.extend(&facts);
        self.bytes.extend(name.as_bytes());
        self.bytes.extend(packed);
        self.files += 1;
        Ok(())
    }

    fn finish(mut self) -> Result<Vec<u8>, String> {
        let size = |bytes: usize| {
            u32::try_from(bytes)
                .map_err(|_| "the archive exceeds the 4 GiB limit of a zip archive".to_owned())
        };
        let (offset, directory) = (size(self.bytes.len())?, size(self.directory.len())?);
        self.bytes.append(&mut self.directory);
        self.bytes.extend(b"PK\x05\x06\x00\x00\x00\x00");
        self.bytes.extend(self.files.to_le_bytes());
        self.bytes.extend(self.files.to_le_bytes());
        self.bytes.extend(directory.to_le_bytes());
        self.bytes.extend(offset.to_le_bytes());
        self.bytes.extend([0; 2]);
        Ok(self.bytes)
    }
}
