//! Volumes written by other programs, compared voxel by voxel with two independent readers each, and their
//! table in `docs/volumes.md`.
//!
//! `make.py` writes the files with pydicom, GDCM, dcmtk, SimpleITK, pynrrd and nibabel, and the results of
//! those readers. With `WRITE_TABLE=1` this test writes the table instead of comparing it.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use test_support::limited::Limited;
use test_support::python;
use volume_io::{Label, ReadOptions, SliceHandling, read_as};
use voxel_grid::Volume;

const PACKAGES: [&str; 8] = [
    "numpy==2.4.6",
    "pydicom==3.0.2",
    "SimpleITK==2.5.7",
    "python-gdcm==3.2.6",
    "pynrrd==1.1.3",
    "nibabel==5.4.2",
    "pylibjpeg[all]==2.1.0",
    "pyjpegls==1.5.1",
];
const PROBE: &str = "numpy, pydicom, SimpleITK, gdcm, nrrd, nibabel, pylibjpeg, openjpeg, jpeg_ls";
/// Position of the table.
const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/volumes.md");
const HEAD: &str = "| format | feature | written by | read alike by |\n|---|---|---|---|\n";

/// Tolerance for directions (rows and columns) and positions, in millimetres: rounding of `f32` affines and
/// of six decimals.
const SAME_MM: f64 = 2e-4;

#[test]
fn every_variant_is_what_two_other_readers_make_of_it() {
    let Some(python) = python::or_skip("volumes-pydicom-3.0.2", &PACKAGES, PROBE) else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/volumes/variants/make.py");
    let made = Command::new(python).arg(script).arg(folder.path()).limited_output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let cases = std::fs::read_to_string(folder.path().join("cases.json")).unwrap();
    let cases: Vec<Value> = serde_json::from_str(&cases).unwrap();
    assert!(cases.len() >= 68, "{}", cases.len());
    let (mut rows, mut wrong) = (Vec::new(), Vec::new());
    for case in &cases {
        match verdict(case) {
            Ok(row) => rows.push(row),
            Err(fault) => wrong.push(format!("{}: {fault}", text(case, "name"))),
        }
    }
    assert!(wrong.is_empty(), "{} of {} differ:\n{}", wrong.len(), cases.len(), wrong.join("\n"));
    compare_table(&rows);
}

fn text<'a>(value: &'a Value, key: &str) -> &'a str {
    value[key].as_str().unwrap()
}

fn options(case: &Value) -> ReadOptions {
    let given = &case["options"];
    let label = match &given["label"] {
        Value::Null => None,
        Value::String(name) => Some(Label::Name(name.clone())),
        number => Some(Label::Value(number.as_i64().unwrap() as i16)),
    };
    let slices = if given["rectify"] == true { SliceHandling::Rectify } else { SliceHandling::AsTheyLie };
    let series = given["series"].as_str().map(str::to_owned);
    ReadOptions { label, slices, series, ..ReadOptions::default() }
}

/// The case's table row, or what is wrong.
fn verdict(case: &Value) -> Result<String, String> {
    let file = PathBuf::from(text(case, "file"));
    let (volume, info) = read_as(&file, &options(case)).map_err(|error| error.to_string())?;
    let tolerance = case["tolerance"].as_i64().unwrap();
    let mut readers = Vec::new();
    for reader in case["readers"].as_array().unwrap() {
        let name = text(reader, "name");
        let worst =
            compare(&volume, reader).map_err(|fault| format!("{name}: {fault}; notes {:?}", info.notes))?;
        if worst > tolerance {
            return Err(format!("{name}: a voxel is off by {worst} HU"));
        }
        readers.push(if worst == 0 { name.to_owned() } else { format!("{name}, within {worst} HU") });
    }
    let (format, feature, by) = (text(case, "format"), text(case, "feature"), text(case, "written_by"));
    Ok(format!("| {format} | {feature} | {by} | {} |", readers.join("; ")))
}

/// The largest voxel difference, if dimensions and geometry agree.
fn compare(volume: &Volume, reader: &Value) -> Result<i64, String> {
    let dims: Vec<usize> =
        reader["dims"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect();
    if dims != volume.grid.dims() {
        return Err(format!("{dims:?} voxels, here {:?}", volume.grid.dims()));
    }
    if let Value::Array(rows) = &reader["affine_mm"] {
        let theirs = |row: usize, column: usize| rows[row][column].as_f64().unwrap();
        for row in 0..3 {
            let mine = |axis: usize| volume.grid.direction()[row][axis] * volume.grid.spacing_m()[axis] * 1e3;
            let off = (0..3).map(|axis| (mine(axis) - theirs(row, axis)).abs()).fold(0.0, f64::max);
            let off = off.max((volume.grid.origin_m()[row] * 1e3 - theirs(row, 3)).abs());
            if off > SAME_MM {
                return Err(format!("row {row} of the affine is off by {off} mm"));
            }
        }
    }
    let bytes = std::fs::read(text(reader, "voxels")).map_err(|error| error.to_string())?;
    let theirs = bytes.chunks_exact(4).map(|b| i64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])));
    let worst = volume.hu.iter().zip(theirs).map(|(mine, theirs)| (i64::from(*mine) - theirs).abs()).max();
    Ok(worst.unwrap_or(i64::MAX))
}

/// Compares the rows with the page's table, or writes it.
fn compare_table(rows: &[String]) {
    let page = std::fs::read_to_string(PAGE).unwrap();
    let begin = page.find(HEAD).unwrap() + HEAD.len();
    let end = begin
        + page[begin..]
            .lines()
            .take_while(|line| line.starts_with('|'))
            .map(|line| line.len() + 1)
            .sum::<usize>();
    if std::env::var_os("WRITE_TABLE").is_some() {
        let table: String = rows.iter().map(|row| format!("{row}\n")).collect();
        std::fs::write(PAGE, [&page[..begin], &table, &page[end..]].concat()).unwrap();
        return;
    }
    let there: Vec<&str> = page[begin..end].lines().collect();
    let missing: Vec<&String> = rows.iter().filter(|row| !there.contains(&row.as_str())).collect();
    assert!(missing.is_empty(), "not in {PAGE}, write it with WRITE_TABLE=1:\n{missing:#?}");
    // Some rows need programs that are not installed everywhere.
    let surplus: Vec<&&str> = there.iter().filter(|line| !rows.iter().any(|row| row == **line)).collect();
    assert!(surplus.iter().all(|line| line.contains("dcmtk")), "no longer so:\n{surplus:#?}");
}
