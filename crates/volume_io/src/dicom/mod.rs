//! DICOM CT series: files in a folder or one by one, classic and enhanced (multi-frame).

mod codec;
mod elements;
mod fields;
mod file;
mod folder;
mod jpeg2000;
mod pixels;
mod scan;
mod series;
mod slice;

pub(crate) use file::{is_dicom, is_part10};
pub(crate) use folder::{read_file, read_folder, sources};
