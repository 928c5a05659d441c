//! Voxels in several data files, as NRRD and MetaImage headers list them: by name, or by a pattern such as
//! `slice%03d.raw 1 40 1`.
//!
//! Sources: "Definition of NRRD File Format", section "Detached headers"; MetaIO documentation,
//! "ElementDataFile". In both, each file holds an equal share of the voxels, in order along the slowest axis.

use crate::error::VolumeError;
use crate::input::{self, DataFiles};
use crate::text_header::wrong;
use std::path::{Path, PathBuf};
use voxel_grid::MAX_VOXELS_ALONG_AXIS;

/// A file that holds voxels from byte `start` on.
pub(crate) struct DataFile {
    pub path: PathBuf,
    pub start: u64,
}

/// The data files that a header's `field` names with `value`: a single file, those of a pattern, or those
/// listed in the lines after `LIST`.
pub(crate) fn named(
    header: &Path,
    (field, value): (&str, &str),
    list: &[String],
    files: DataFiles,
) -> Result<Vec<DataFile>, VolumeError> {
    let names = match is_list(value) {
        true => within_list(header, field, list)?,
        false => pattern(header, field, value)?.unwrap_or_else(|| vec![value.to_owned()]),
    };
    let find = |name: &String| Ok(DataFile { path: input::data_file(header, field, name, files)?, start: 0 });
    names.iter().map(find).collect()
}

/// Whether a value announces a list of file names, one per line.
pub(crate) fn is_list(value: &str) -> bool {
    value.split_whitespace().next() == Some("LIST")
}

/// The names in the lines after the word `LIST`.
fn within_list(path: &Path, field: &str, lines: &[String]) -> Result<Vec<String>, VolumeError> {
    let names: Vec<String> = lines.iter().filter(|line| !line.is_empty()).cloned().collect();
    if names.is_empty() || names.len() > MAX_VOXELS_ALONG_AXIS {
        let given = format!("LIST and {} names", names.len());
        return Err(wrong(path, field, &given, &format!("1 to {MAX_VOXELS_ALONG_AXIS} names, one per line")));
    }
    Ok(names)
}

/// The names that a pattern generates; `None` for a plain name.
fn pattern(path: &Path, field: &str, value: &str) -> Result<Option<Vec<String>>, VolumeError> {
    let words: Vec<&str> = value.split_whitespace().collect();
    // The name may contain spaces; three numbers follow it, or four with the number of axes per file.
    let numbers = words.iter().rev().take_while(|word| word.parse::<i64>().is_ok()).count();
    if !value.contains('%') || numbers < 3 {
        return if value.contains('%') { Err(bad_pattern(path, field, value)) } else { Ok(None) };
    }
    let used = if numbers >= 4 { 4 } else { 3 };
    let (name, tail) = words.split_at(words.len() - used);
    let template = Template::parse(&name.join(" ")).ok_or_else(|| bad_pattern(path, field, value))?;
    let mut range = tail.iter().filter_map(|word| word.parse::<i64>().ok());
    let (Some(first), Some(last), Some(step)) = (range.next(), range.next(), range.next()) else {
        return Err(bad_pattern(path, field, value));
    };
    let count = last.checked_sub(first).zip(Some(step)).and_then(|(span, step)| span.checked_div(step));
    let count = count.filter(|n| (0..MAX_VOXELS_ALONG_AXIS as i64).contains(n));
    let count = count.ok_or_else(|| bad_pattern(path, field, value))?;
    // Cannot overflow: every number lies between `first` and `last`.
    Ok(Some((0..=count).map(|n| template.name(first + n * step)).collect()))
}

fn bad_pattern(path: &Path, field: &str, value: &str) -> VolumeError {
    let expected = format!(
        "a name with one %d or %03d, then first, last and step, such as `slice%03d.raw 1 40 1`, of at most \
         {MAX_VOXELS_ALONG_AXIS} files"
    );
    wrong(path, field, value, &expected)
}

/// A name with one number in it: `slice%03d.raw`.
struct Template {
    before: String,
    width: usize,
    zeros: bool,
    after: String,
}

impl Template {
    fn parse(text: &str) -> Option<Self> {
        let (before, rest) = text.split_once('%')?;
        let end = rest.find(|c: char| !c.is_ascii_digit())?;
        let (digits, rest) = rest.split_at(end);
        let after = rest.strip_prefix(['d', 'i', 'u'])?;
        let width = if digits.is_empty() { 0 } else { digits.parse().ok().filter(|width| *width <= 20)? };
        let valid = !after.contains('%');
        valid.then(|| Self {
            before: before.into(),
            width,
            zeros: digits.starts_with('0'),
            after: after.into(),
        })
    }

    fn name(&self, number: i64) -> String {
        let Self { before, width, after, .. } = self;
        if self.zeros {
            format!("{before}{number:0width$}{after}")
        } else {
            format!("{before}{number:width$}{after}")
        }
    }
}

/// Reads `count` numbers, an equal part from each file.
pub(crate) fn read_each(
    header: &Path,
    field: &str,
    files: &[DataFile],
    count: usize,
    mut read: impl FnMut(&DataFile, usize) -> Result<(), VolumeError>,
) -> Result<(), VolumeError> {
    if files.is_empty() || !count.is_multiple_of(files.len()) {
        let given = format!("{} files for {count} voxels", files.len());
        return Err(wrong(header, field, &given, "the same number of voxels in each file"));
    }
    files.iter().try_for_each(|file| read(file, count / files.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(value: &str) -> Option<Vec<String>> {
        pattern(Path::new("v.nhdr"), "data file", value).unwrap()
    }

    #[test]
    fn a_pattern_names_its_files() {
        assert_eq!(names("v.raw"), None);
        assert_eq!(names("s%03d.raw 9 11 1").unwrap(), ["s009.raw", "s010.raw", "s011.raw"]);
        assert_eq!(names("a b%d 3 1 -2 2").unwrap(), ["a b3", "a b1"]);
        assert_eq!(names("%2d.z 5 5 1").unwrap(), [" 5.z"]);
    }

    #[test]
    fn a_pattern_without_an_end_or_of_another_kind_is_refused() {
        let path = Path::new("v.nhdr");
        for value in [
            "s%d 1 2 0",
            "s%d 2 1 1",
            "s%d 1 99999999 1",
            "s%d 1 2",
            "s%s 1 2 1",
            "s%d%d 1 2 1",
            "s%099d 1 2 1",
            "s% 1 2 1",
            "s%d -9223372036854775808 9223372036854775807 1",
        ] {
            assert!(pattern(path, "data file", value).is_err(), "{value}");
        }
    }
}
