//! Collects the files of a folder that belong to the series to be read.

use super::file::{HEAD_BYTES, is_dicom};
use super::series::assemble;
use super::slice::{Identity, Images, Slice, identify, read_headers};
use crate::error::{Field, VolumeError};
use crate::input::{self, Codec, DataFiles, folder_of};
use crate::options::ReadOptions;
use crate::sources::Sources;
use crate::volume::VolumeInfo;
use foreign_text::foreign;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use voxel_grid::Volume;

/// Limits of the search below a folder: depth, and number of entries in all. A CD of one patient stays far
/// below both.
const MAX_DEPTH: usize = 8;
const MAX_ENTRIES: usize = 200_000;
/// Series listed in an error; the rest are only counted.
const LISTED: usize = 12;

/// Reads a series in a folder or below it: the selected one, or the only one.
pub(crate) fn read_folder(folder: &Path, options: &ReadOptions) -> Result<(Volume, VolumeInfo), VolumeError> {
    let found = Found::of(folder, options, 0)?;
    let mut series: BTreeMap<String, Series> = BTreeMap::new();
    let (mut others, mut localizers) = (found.others, 0);
    for file in found.files {
        let identity = identify(&file)?;
        match identity.images {
            Images::None => others += 1,
            Images::Localizer => localizers += 1,
            Images::Frames(frames) => {
                series.entry(identity.series_uid.clone()).or_default().add(file, frames, identity)
            }
        }
    }
    if series.is_empty() {
        let given = format!("a folder without DICOM slices ({others} other files, {localizers} localizers)");
        return Err(VolumeError::not_a_volume(folder, given));
    }
    let count = series.len();
    let chosen = chosen(folder, series, options.series.as_deref())?;
    let mut notes = Vec::new();
    if count > 1 {
        notes.push(format!("{} other series in the folder ignored", count - 1));
    }
    if others > 0 {
        notes.push(format!("{others} files ignored: not DICOM images"));
    }
    if localizers > 0 {
        notes.push(format!("{localizers} localizers ignored"));
    }
    let mut slices = Vec::new();
    for file in chosen.files {
        slices.extend(read_headers(&file)?);
    }
    assemble(folder, slices, options.slices, notes)
}

/// The files that [`read_folder`] reads, and what else its notes depend on.
pub(crate) fn sources(folder: &Path, options: &ReadOptions) -> Result<Sources, VolumeError> {
    let found = Found::of(folder, options, 0)?;
    // Relative, so that a moved folder has the same key.
    let name = |file: &PathBuf| file.strip_prefix(folder).unwrap_or(file).to_string_lossy().into_owned();
    let mut names: Vec<String> = found.files.iter().map(name).collect();
    names.push(format!("{} other files", found.others));
    Ok(Sources { files: found.files, names, are_encoded: true })
}

/// The selected series, or the only one.
fn chosen(
    folder: &Path,
    mut series: BTreeMap<String, Series>,
    wanted: Option<&str>,
) -> Result<Series, VolumeError> {
    let refuse = |series: &BTreeMap<String, Series>| VolumeError::SeveralSeries {
        path: folder.into(),
        given: wanted.map_or_else(
            || "no series selected".to_owned(),
            |uid| format!("series {} not found", foreign(uid)),
        ),
        series: list(series),
    };
    if let Some(uid) = wanted {
        return series.remove(uid).ok_or_else(|| refuse(&series));
    }
    if series.len() > 1 {
        return Err(refuse(&series));
    }
    series.pop_first().map(|(_, series)| series).ok_or_else(|| refuse(&BTreeMap::new()))
}

/// The series on one line, longest first.
fn list(series: &BTreeMap<String, Series>) -> String {
    let mut all: Vec<_> = series.iter().collect();
    all.sort_by_key(|(_, series)| std::cmp::Reverse(series.slices));
    let each = all.iter().take(LISTED).map(|(uid, series)| {
        let Series { slices, modality, description, .. } = series;
        let description = foreign(description.trim());
        format!("{} ({slices} slices, {}, \"{description}\")", foreign(uid), foreign(modality))
    });
    let mut text = each.collect::<Vec<_>>().join("; ");
    if all.len() > LISTED {
        text.push_str(&format!("; and {} more", all.len() - LISTED));
    }
    text
}

/// Reads the series of a DICOM file: every file beside it with the same SeriesInstanceUID.
pub(crate) fn read_file(path: &Path, options: &ReadOptions) -> Result<(Volume, VolumeInfo), VolumeError> {
    let identity = identify(path)?;
    if identity.images == Images::None {
        let given = "a DICOM file without an image".to_owned();
        return Err(VolumeError::not_a_volume(path, given));
    }
    let mut slices: Vec<Slice> = read_headers(path)?;
    let uid = identity.series_uid.as_str();
    let mut notes = Vec::new();
    if !uid.is_empty() && identity.images != Images::Localizer {
        let folder = folder_of(path);
        // Only the files beside it.
        let found = Found::of(folder, options, MAX_DEPTH + 1)?;
        let own_name = path.file_name();
        let mut localizers = 0;
        for file in found.files.into_iter().filter(|file| file.file_name() != own_name) {
            // A file that cannot be identified does not belong to the series.
            let Some(other) = identify(&file).ok().filter(|other| other.series_uid == uid) else { continue };
            match other.images {
                Images::None => {}
                Images::Localizer => localizers += 1,
                Images::Frames(_) => slices.extend(read_headers(&file)?),
            }
        }
        if localizers > 0 {
            notes.push(format!("{localizers} localizers ignored"));
        }
    }
    assemble(path, slices, options.slices, notes)
}

/// The files of one series.
#[derive(Default)]
struct Series {
    files: Vec<PathBuf>,
    slices: usize,
    modality: String,
    description: String,
}

impl Series {
    fn add(&mut self, file: PathBuf, frames: usize, identity: Identity) {
        self.files.push(file);
        self.slices += frames;
        (self.modality, self.description) = (identity.modality, identity.description);
    }
}

/// DICOM files found in a folder.
struct Found {
    where_to: DataFiles,
    files: Vec<PathBuf>,
    others: usize,
    entries: usize,
}

impl Found {
    /// The DICOM files of a folder at this depth, sorted.
    fn of(folder: &Path, options: &ReadOptions, depth: usize) -> Result<Found, VolumeError> {
        let mut found = Found { where_to: options.data_files, files: Vec::new(), others: 0, entries: 0 };
        found.look_into(folder, folder, depth)?;
        found.files.sort();
        Ok(found)
    }

    /// Collects the DICOM files of a folder and of those below it, except DICOMDIR indexes. Refuses links to
    /// DICOM files elsewhere unless `where_to` allows them: an untrusted folder may contain links to the
    /// user's own images.
    fn look_into(&mut self, root: &Path, folder: &Path, depth: usize) -> Result<(), VolumeError> {
        for entry in std::fs::read_dir(folder).map_err(input::io_error(folder, "list"))? {
            let path = entry.map_err(input::io_error(folder, "list"))?.path();
            self.entries += 1;
            if self.entries > MAX_ENTRIES {
                return Err(VolumeError::unsupported(
                    root,
                    "folder",
                    format!("more than {MAX_ENTRIES} files"),
                    "the folder of one study",
                ));
            }
            if path.is_dir() {
                // A link to a folder could form a cycle.
                if depth == MAX_DEPTH && !path.is_symlink() {
                    return Err(VolumeError::unsupported(
                        root,
                        "folder",
                        format!("folders nested more than {MAX_DEPTH} deep"),
                        "the folder of one study",
                    ));
                }
                if depth < MAX_DEPTH && !path.is_symlink() {
                    self.look_into(root, &path, depth + 1)?;
                }
                continue;
            }
            let is_index = path.file_name().is_some_and(|name| name == "DICOMDIR");
            if !path.is_file() || is_index || !is_dicom(&input::head(&path, 0, Codec::Raw, HEAD_BYTES)?) {
                self.others += 1;
                continue;
            }
            if input::inside(root, &path, self.where_to)?.is_none() {
                return Err(VolumeError::Elsewhere(Field::new(
                    root,
                    "link",
                    format!("`{}`", path.file_name().unwrap_or_default().to_string_lossy()),
                )));
            }
            self.files.push(path);
        }
        Ok(())
    }
}
