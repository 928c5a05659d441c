//! Risk of a plan under the uncertainty of registration and tool: shares of sampled runs.

use std::path::Path;

use serde::Serialize;
use sweep::{Proportion, Study};

use super::outcome::{Fault, Outcome};
use super::parallel::on_all_cores;
use super::{Candidate, Search, changed};
use crate::failure::Failure;

/// The study that is used if none is named.
const STUDY: &str = include_str!("../../configs/sweeps/uncertainty.toml");

/// Reads a study of what is uncertain, with the table of points that it may name.
///
/// # Errors
/// Bad input: not a study, or an unreadable file.
pub fn study(file: Option<&Path>) -> Result<Study, Failure> {
    let Some(file) = file else {
        return Study::parse(STUDY, Path::new("uncertainty.toml"), None).map_err(Failure::bad_input);
    };
    let text = inputs::text::read(file)?;
    let points = Study::points_file(&text, file).map_err(Failure::bad_input)?;
    let points = points.map(|points| inputs::text::read(&output_file::folder_of(file).join(points)));
    Study::parse(&text, file, points.transpose()?.as_deref()).map_err(Failure::bad_input)
}

/// Shares of sampled runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Risk {
    /// Runs in which the tool left the bone or entered a structure.
    pub breach: Proportion,
    /// Runs in which the target was missed, with those that were refused or failed.
    pub miss: Proportion,
    /// Runs that were refused, for example because the arm would be in bone.
    pub refused: u64,
}

impl Risk {
    fn of(outcomes: &[Outcome]) -> Risk {
        let count =
            |is_so: fn(&Outcome) -> bool| outcomes.iter().filter(|outcome| is_so(outcome)).count() as u64;
        let share = |is_so| Proportion { count: count(is_so), of: outcomes.len() as u64 };
        Risk {
            breach: share(|outcome| outcome.is_breached),
            miss: share(|outcome| outcome.is_missed),
            refused: count(|outcome| outcome.fault == Some(Fault::Refused)),
        }
    }
}

impl Search<'_> {
    /// Runs each plan with the first `samples` points of a study.
    ///
    /// # Errors
    /// Bad input (2): the study sets a key that the scene does not have; out of memory (1); Ctrl-C (130).
    pub fn risks(&self, plans: &[&Candidate], study: &Study, samples: u64) -> Result<Vec<Risk>, Failure> {
        let settings = |point: u64| [study.set.clone(), study.point(point).settings()].concat();
        let samples = samples.min(study.count());
        if samples > 0 {
            changed(&self.source, &self.text).with(&settings(0))?.has_the_keys()?;
        }
        let all: Vec<(&str, u64)> =
            plans.iter().flat_map(|plan| (0..samples).map(|point| (plan.text.as_str(), point))).collect();
        let outcomes = on_all_cores(&all, |(text, point)| self.outcome(text, &settings(*point)))?;
        let of_plan = |index: usize| {
            let first = index * samples as usize;
            Risk::of(&outcomes[first..first + samples as usize])
        };
        Ok((0..plans.len()).map(of_plan).collect())
    }
}
