//! A study: the validated file of a sweep.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::Value;

use crate::design::{Design, MAX_SOBOL_SAMPLES, Sampling};
use crate::error::StudyError;
use crate::parameter::Parameter;
use crate::table::Table;

/// Maximum number of parameters of a study.
pub const MAX_PARAMETERS: usize = 64;
/// Maximum number of points of a study.
pub const MAX_POINTS: u64 = 1_000_000;

/// Which logs to keep.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Record {
    /// None; the row's command recreates it.
    #[default]
    None,
    /// All, without X-ray frames for runs in this process.
    All,
    /// All, with X-ray frames; each run is a session.
    Frames,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Text {
    scene: Option<PathBuf>,
    design: Design,
    samples: Option<u64>,
    #[serde(default)]
    seed: u64,
    #[serde(default)]
    set: Vec<String>,
    points: Option<PathBuf>,
    #[serde(default)]
    record: Record,
    #[serde(default)]
    parameter: Vec<Parameter>,
}

/// A study: the scenes of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Study {
    /// Scene file, relative to the study's folder; `None` for the built-in femur.
    pub scene: Option<PathBuf>,
    /// Distribution of the points.
    pub design: Design,
    /// Settings of every run, each `KEY=VALUE`, applied before those of the point.
    pub set: Vec<String>,
    /// Which logs to keep.
    pub record: Record,
    sampling: Sampling,
    parameters: Vec<Parameter>,
    table: Table,
}

/// One run of a study.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Index, from 0.
    pub index: u64,
    /// Keys and values, in the study's order.
    pub values: Vec<(String, Value)>,
}

impl Point {
    /// Returns `KEY=VALUE` settings for `trabecula run --set`.
    pub fn settings(&self) -> Vec<String> {
        self.values.iter().map(|(key, value)| format!("{key}={value}")).collect()
    }
}

impl Study {
    /// Parses a study. `table` is the text of the file named by `points` ([`Study::points_file`]).
    ///
    /// # Errors
    /// Not TOML, a value out of range, or conflicting keys.
    pub fn parse(text: &str, file: &Path, table: Option<&str>) -> Result<Study, StudyError> {
        let read = read(text, file)?;
        let contradiction = |key: &str, problem: &str| StudyError::Contradiction {
            file: file.to_owned(),
            key: key.to_owned(),
            problem: problem.to_owned(),
        };
        let is_csv = read.design == Design::Csv;
        if is_csv != read.points.is_some() {
            return Err(contradiction(
                "points",
                "is required by `design = \"csv\"` and not allowed otherwise",
            ));
        }
        if is_csv != read.parameter.is_empty() {
            let problem = if is_csv { "is not allowed with `design = \"csv\"`" } else { "is missing" };
            return Err(contradiction("parameter", problem));
        }
        let samples = read.samples;
        if matches!(read.design, Design::Csv | Design::Grid) == samples.is_some() {
            return Err(contradiction(
                "samples",
                "is required by all designs except grid and csv, where it is not allowed",
            ));
        }
        if read.parameter.len() > MAX_PARAMETERS {
            return Err(contradiction("parameter", &format!("has more than {MAX_PARAMETERS} entries")));
        }
        let is_grid = read.design == Design::Grid;
        read.parameter.iter().enumerate().try_for_each(|(i, p)| p.check(i, file, is_grid))?;
        let table = match (&read.points, table) {
            (Some(points), Some(table)) => Table::parse(table, points)?,
            _ => Table::default(),
        };
        let study = Study {
            scene: read.scene,
            design: read.design,
            set: read.set,
            record: read.record,
            sampling: Sampling { seed: read.seed, samples: samples.unwrap_or(0) },
            parameters: read.parameter,
            table,
        };
        study.check_keys(file)?;
        study.check_count(file)?;
        Ok(study)
    }

    /// Returns the file named by `points`, relative to the study's folder; `None` for most designs.
    ///
    /// # Errors
    /// Not a study.
    pub fn points_file(text: &str, file: &Path) -> Result<Option<PathBuf>, StudyError> {
        Ok(read(text, file)?.points)
    }

    fn check_keys(&self, file: &Path) -> Result<(), StudyError> {
        let mut seen = BTreeSet::new();
        match self.keys().into_iter().find(|key| !seen.insert(*key)) {
            Some(twice) => Err(StudyError::Contradiction {
                file: file.to_owned(),
                key: twice.to_owned(),
                problem: "is a duplicate key".to_owned(),
            }),
            None => Ok(()),
        }
    }

    fn check_count(&self, file: &Path) -> Result<(), StudyError> {
        let bad = |key: &str, given: String, expected: String| {
            Err(StudyError::Value { file: file.to_owned(), key: key.to_owned(), given, expected })
        };
        let samples = self.sampling.samples;
        let most = match self.design {
            Design::Sobol => MAX_SOBOL_SAMPLES,
            Design::Saltelli => MAX_SOBOL_SAMPLES.min(MAX_POINTS / (self.parameters.len() as u64 + 2)),
            _ => MAX_POINTS,
        };
        if !matches!(self.design, Design::Grid | Design::Csv) && !(1..=most).contains(&samples) {
            return bad("samples", samples.to_string(), format!("1 to {most}"));
        }
        if self.grid_count().is_none() {
            return bad(
                "parameter",
                "a grid with too many points".to_owned(),
                format!("at most {MAX_POINTS} points"),
            );
        }
        Ok(())
    }

    fn grid_count(&self) -> Option<u64> {
        let mut counts = self.parameters.iter().map(Parameter::grid_count);
        counts.try_fold(1_u64, |count, n| count.checked_mul(n).filter(|count| *count <= MAX_POINTS))
    }

    /// Returns the keys that it varies.
    pub fn keys(&self) -> Vec<&str> {
        match self.design {
            Design::Csv => self.table.keys.iter().map(String::as_str).collect(),
            _ => self.parameters.iter().map(|parameter| parameter.key.as_str()).collect(),
        }
    }

    /// Returns the number of points.
    pub fn count(&self) -> u64 {
        match self.design {
            Design::Grid => self.grid_count().unwrap_or(0),
            Design::Csv => self.table.rows.len() as u64,
            Design::Saltelli => self.sampling.samples * (self.parameters.len() as u64 + 2),
            Design::Random | Design::LatinHypercube | Design::Sobol => self.sampling.samples,
        }
    }

    /// Returns point `index`, which must be below [`Study::count`].
    pub fn point(&self, index: u64) -> Point {
        if self.design == Design::Csv {
            let row = self.table.rows.get(index as usize);
            let values = self.table.keys.iter().zip(row.into_iter().flatten());
            return Point {
                index,
                values: values.map(|(key, value)| (key.clone(), value.clone())).collect(),
            };
        }
        let dimensions = self.parameters.len();
        let mut values: Vec<(String, Value)> = Vec::with_capacity(dimensions);
        let mut rest = index;
        let mut places = vec![0; dimensions];
        for (place, parameter) in places.iter_mut().zip(&self.parameters).rev() {
            (*place, rest) = (rest % parameter.grid_count(), rest / parameter.grid_count());
        }
        for (dimension, parameter) in self.parameters.iter().enumerate() {
            let value = match self.design {
                Design::Grid => parameter.of_grid(places[dimension]),
                design => parameter.at(design.unit(index, (dimension, dimensions), self.sampling)),
            };
            values.push((parameter.key.clone(), value));
        }
        Point { index, values }
    }
}

fn read(text: &str, file: &Path) -> Result<Text, StudyError> {
    toml::from_str(text).map_err(|error| {
        let line = foreign_text::line_at(text, error.span().map_or(0, |span| span.start));
        StudyError::Malformed { file: file.to_owned(), line, cause: error.message().to_owned() }
    })
}
