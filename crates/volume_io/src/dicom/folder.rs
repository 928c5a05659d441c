//! Collects the files of a folder that belong to the series to be read.

use super::file::{HEAD_BYTES, is_dicom};
use super::series::assemble;
use super::slice::{Identity, Images, Slice, identify};
use crate::error::{Field, VolumeError};
use crate::input::{self, Codec, DataFiles, folder_of};
use crate::options::ReadOptions;
use crate::sources::Sources;
use crate::volume::VolumeInfo;
use foreign_text::{counted, foreign};
use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
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
    let choice = options.series.as_deref().map(Choice::of);
    let found = Found::of(folder, options, 0)?;
    let mut series: BTreeMap<String, Series> = BTreeMap::new();
    let (mut others, mut localizers) = (found.others, 0);
    let (mut damaged, mut slices) = (Damaged::default(), 0);
    for file in found.files {
        let Some(identity) = damaged.identify(&file)? else { continue };
        match identity.images {
            Images::None => others += 1,
            Images::Localizer => localizers += 1,
            Images::Frames(frames) => {
                slices += identity.slices.as_ref().map_or(0, Vec::len);
                check_count(folder, slices)?;
                let uid = match choice {
                    Some(Choice { uid: ALL, .. }) => ALL.to_owned(),
                    _ => identity.series_uid.clone(),
                };
                series.entry(uid).or_default().add(file, frames, identity);
            }
        }
    }
    if series.is_empty() {
        damaged.refuse_any()?;
        let given = format!("a folder without DICOM slices ({others} other files, {localizers} localizers)");
        return Err(VolumeError::not_a_volume(folder, given));
    }
    let count = series.len();
    let (uid, chosen) = chosen(folder, series, choice.map(|choice| choice.uid))?;
    // Without a choice, a file of an unknown series might belong to the only one.
    let mut notes = match choice {
        None => damaged.refuse_unknown(&uid)?,
        Some(_) => damaged.refuse_series(&uid)?,
    };
    if count > 1 {
        notes.push(format!("{} other series in the folder ignored", count - 1));
    }
    if uid == ALL {
        notes.push(format!("{} series joined, as asked for by `{ALL}`", chosen.uids.len()));
    }
    if others > 0 {
        notes.push(format!("{} ignored: not DICOM images", counted(others, "file")));
    }
    if localizers > 0 {
        notes.push(format!("{localizers} localizers ignored"));
    }
    let mut stack = Stack::default();
    for (file, slices) in chosen.files {
        stack.add(&file, slices?)?;
    }
    let slices = stack.finish(folder, choice.and_then(|choice| choice.phase), &mut notes)?;
    assemble(folder, slices, options, notes)
}

/// The choice that joins all series of a folder.
const ALL: &str = "all";

/// Which series, and which of its phases: `UID`, `UID#2`, or `all`.
#[derive(Clone, Copy)]
struct Choice<'a> {
    uid: &'a str,
    /// From 1, as listed in the error for a series of several.
    phase: Option<&'a str>,
}

impl<'a> Choice<'a> {
    fn of(text: &'a str) -> Self {
        match text.split_once('#') {
            Some((uid, phase)) => Self { uid, phase: Some(phase) },
            None => Self { uid: text, phase: None },
        }
    }
}

/// Files that cannot be read, with the series that they state, if they do.
#[derive(Default)]
struct Damaged(Vec<(Option<String>, VolumeError)>);

impl Damaged {
    /// Identifies a file; `None` for one that cannot be read, which is kept.
    ///
    /// # Errors
    /// `Io`.
    fn identify(&mut self, file: &Path) -> Result<Option<Identity>, VolumeError> {
        match identify(file) {
            Ok(Identity { problem: Some(problem), series_uid, .. }) => {
                self.0.push((Some(series_uid).filter(|uid| !uid.is_empty()), problem));
                Ok(None)
            }
            Ok(identity) => Ok(Some(identity)),
            Err(error @ VolumeError::Io { .. }) => Err(error),
            Err(problem) => {
                self.0.push((None, problem));
                Ok(None)
            }
        }
    }

    /// Refuses a folder in which any file cannot be read.
    fn refuse_any(self) -> Result<(), VolumeError> {
        self.0.into_iter().next().map_or(Ok(()), |(_, problem)| Err(problem))
    }

    /// Refuses a damaged file of this series; returns a note on the others.
    fn refuse_series(self, uid: &str) -> Result<Vec<String>, VolumeError> {
        self.refuse(|of| uid == ALL || of == Some(uid))
    }

    /// Refuses a damaged file of this series, or of an unknown one; returns a note on the others.
    fn refuse_unknown(self, uid: &str) -> Result<Vec<String>, VolumeError> {
        self.refuse(|of| of.is_none_or(|of| of == uid))
    }

    fn refuse(self, belongs: impl Fn(Option<&str>) -> bool) -> Result<Vec<String>, VolumeError> {
        let count = self.0.len();
        let mut first = None;
        for (uid, problem) in self.0 {
            if belongs(uid.as_deref()) {
                return Err(problem);
            }
            first.get_or_insert(problem);
        }
        let note = |problem| format!("unreadable DICOM files ignored: {count}; the first: {problem}");
        Ok(first.map(note).into_iter().collect())
    }
}

/// The slices of a series, in which identical copies count once.
#[derive(Default)]
struct Stack {
    slices: Vec<Slice>,
    /// The file of each SOPInstanceUID.
    instances: BTreeMap<String, PathBuf>,
    copies: usize,
}

impl Stack {
    /// Adds the slices of a file, unless it is a copy of an earlier one.
    fn add(&mut self, file: &Path, slices: Vec<Slice>) -> Result<(), VolumeError> {
        if let Some(uid) = slices.first().and_then(|slice| slice.sop_instance_uid.clone()) {
            if let Some(earlier) = self.instances.get(&uid) {
                let bytes = |path: &Path| std::fs::read(path).map_err(input::io_error(path, "read"));
                if bytes(earlier)? == bytes(file)? {
                    self.copies += 1;
                    return Ok(());
                }
            }
            self.instances.entry(uid).or_insert_with(|| file.to_owned());
        }
        self.slices.extend(slices);
        Ok(())
    }

    /// The slices, or those of the chosen phase.
    fn finish(
        self,
        path: &Path,
        phase: Option<&str>,
        notes: &mut Vec<String>,
    ) -> Result<Vec<Slice>, VolumeError> {
        if self.copies > 0 {
            notes.push(format!("identical copies of slices ignored: {}", self.copies));
        }
        let mut phases = phases(&self.slices);
        let each = phases.iter().enumerate().take(LISTED);
        let listed: Vec<String> =
            each.map(|(index, phase)| format!("#{} ({} slices)", index + 1, phase.len())).collect();
        let refuse = |given: String| {
            Err(VolumeError::SeveralPhases { path: path.into(), given, phases: listed.join(", ") })
        };
        let Some(number) = phase else {
            return match phases.len() {
                0 => Ok(self.slices),
                count => refuse(format!("the series holds {count} phases, with the same positions")),
            };
        };
        let index = number.parse::<usize>().ok().and_then(|number| number.checked_sub(1));
        let Some(index) = index.filter(|index| *index < phases.len()) else {
            return refuse(format!("phase `#{}` not found", foreign(number)));
        };
        notes.push(format!("other phases of the series ignored: {}", phases.len() - 1));
        Ok(phases.swap_remove(index))
    }
}

/// The phases of a series in which slices share positions: by what tells phases apart, or by multi-frame
/// file. Empty if no positions are shared, or if these leave shared ones.
fn phases(slices: &[Slice]) -> Vec<Vec<Slice>> {
    let apart = |slices: &[Slice]| {
        let places: BTreeSet<_> = slices.iter().map(|slice| slice.position_mm.map(f64::to_bits)).collect();
        places.len() == slices.len()
    };
    if apart(slices) {
        return Vec::new();
    }
    // Without NaN, which is in no order with the others.
    let number = |text: &Option<String>| text.as_ref()?.parse::<f64>().ok().filter(|n| !n.is_nan());
    let stated = |a: &Slice, b: &Slice| {
        let each = a.phase.iter().zip(&b.phase);
        let order = each.map(|(a, b)| number(a).partial_cmp(&number(b)).unwrap_or(Ordering::Equal));
        order.fold(Ordering::Equal, Ordering::then)
    };
    let filed = |a: &Slice, b: &Slice| (a.frames.min(2), &a.path).cmp(&(b.frames.min(2), &b.path));
    let split = |order: &dyn Fn(&Slice, &Slice) -> Ordering| -> Vec<Vec<Slice>> {
        let mut sorted = slices.to_vec();
        sorted.sort_by(order);
        sorted.chunk_by(|a, b| order(a, b) == Ordering::Equal).map(<[Slice]>::to_vec).collect()
    };
    let is_split = |phases: &Vec<Vec<Slice>>| phases.len() > 1 && phases.iter().all(|phase| apart(phase));
    let by_file = || if slices.iter().all(|slice| slice.frames > 1) { split(&filed) } else { Vec::new() };
    Some(split(&stated))
        .filter(is_split)
        .unwrap_or_else(|| Some(by_file()).filter(is_split).unwrap_or_default())
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

/// The selected series, or the only one, with its UID.
fn chosen(
    folder: &Path,
    mut series: BTreeMap<String, Series>,
    wanted: Option<&str>,
) -> Result<(String, Series), VolumeError> {
    let refuse = |series: &BTreeMap<String, Series>| VolumeError::SeveralSeries {
        path: folder.into(),
        given: wanted.map_or_else(
            || "no series selected".to_owned(),
            |uid| format!("series {} not found", foreign(uid)),
        ),
        series: list(series),
    };
    if let Some(uid) = wanted {
        return series.remove_entry(uid).ok_or_else(|| refuse(&series));
    }
    if series.len() > 1 {
        return Err(refuse(&series));
    }
    series.pop_first().ok_or_else(|| refuse(&BTreeMap::new()))
}

/// The series on one line, longest first.
fn list(series: &BTreeMap<String, Series>) -> String {
    let mut all: Vec<_> = series.iter().collect();
    all.sort_by_key(|(_, series)| std::cmp::Reverse(series.slices));
    let each = all.iter().take(LISTED).map(|(uid, series)| {
        let Series { slices, modality, description, .. } = series;
        let description = foreign(description.trim());
        let slices = counted(slices, "slice");
        format!("{} ({slices}, {}, \"{description}\")", foreign(uid), foreign(modality))
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
    if let Some(problem) = identity.problem {
        return Err(problem);
    }
    if identity.images == Images::None {
        let given = "a DICOM file without an image".to_owned();
        return Err(VolumeError::not_a_volume(path, given));
    }
    let uid = identity.series_uid.as_str();
    let choice = options.series.as_deref().map(Choice::of);
    if let Some(Choice { uid: wanted, .. }) = choice.filter(|choice| choice.uid != uid) {
        let (given, series) = match wanted {
            ALL => ("`all` joins the series of a folder, but this is a file".to_owned(), uid),
            wanted => (format!("series {} not found", foreign(wanted)), uid),
        };
        return Err(VolumeError::SeveralSeries {
            path: path.into(),
            given,
            series: foreign(series).to_string(),
        });
    }
    let mut stack = Stack::default();
    stack.add(path, identity.slices?)?;
    let mut notes = Vec::new();
    if !uid.is_empty() && identity.images != Images::Localizer {
        let folder = folder_of(path);
        // Only the files beside it.
        let found = Found::of(folder, options, MAX_DEPTH + 1)?;
        let own_name = path.file_name();
        let (mut localizers, mut damaged) = (0, Damaged::default());
        for file in found.files.into_iter().filter(|file| file.file_name() != own_name) {
            let other = damaged.identify(&file)?.filter(|other| other.series_uid == uid);
            match other {
                Some(Identity { images: Images::Localizer, .. }) => localizers += 1,
                Some(Identity { images: Images::Frames(_), slices, .. }) => stack.add(&file, slices?)?,
                _ => {}
            }
            check_count(folder, stack.slices.len())?;
        }
        notes = damaged.refuse_series(uid)?;
        if localizers > 0 {
            notes.push(format!("{localizers} localizers ignored"));
        }
    }
    let slices = stack.finish(path, choice.and_then(|choice| choice.phase), &mut notes)?;
    assemble(path, slices, options, notes)
}

/// The files of one series.
#[derive(Default)]
struct Series {
    files: Vec<(PathBuf, Result<Vec<Slice>, VolumeError>)>,
    slices: usize,
    modality: String,
    description: String,
    uids: BTreeSet<String>,
}

impl Series {
    fn add(&mut self, file: PathBuf, frames: usize, identity: Identity) {
        self.files.push((file, identity.slices));
        self.slices += frames;
        self.uids.insert(identity.series_uid);
        (self.modality, self.description) = (identity.modality, identity.description);
    }
}

fn too_large(folder: &Path, given: String) -> VolumeError {
    VolumeError::unsupported(folder, "folder", given, "the folder of one study")
}

/// Refuses more slices than a folder may have files: a few bytes of an enhanced image can be a slice.
fn check_count(folder: &Path, slices: usize) -> Result<(), VolumeError> {
    let is_one_study = slices <= MAX_ENTRIES;
    is_one_study.then_some(()).ok_or_else(|| too_large(folder, format!("more than {MAX_ENTRIES} slices")))
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
                return Err(too_large(root, format!("more than {MAX_ENTRIES} files")));
            }
            if path.is_dir() {
                // A link to a folder could form a cycle.
                if depth == MAX_DEPTH && !path.is_symlink() {
                    return Err(too_large(root, format!("folders nested more than {MAX_DEPTH} deep")));
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
