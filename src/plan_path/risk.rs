//! Risk of a plan under the uncertainty of registration and tool: shares of sampled runs.

use std::path::Path;

use foreign_text::counted;
use serde::Serialize;
use sim::on_all_cores;
use sweep::{Proportion, Study};

use super::outcome::{Fault, Outcome};
use super::{Candidate, Search, changed};
use crate::failure::Failure;

/// The study that is used if none is named.
const STUDY: &str = include_str!("../../configs/sweeps/uncertainty.toml");

/// What is uncertain about the world in which a plan is run: a study that only sets keys of `[truth]`.
pub struct Uncertainty {
    study: Study,
    /// Names the study in messages.
    name: String,
}

impl Uncertainty {
    /// Reads a study, with the table of points that it may name.
    ///
    /// # Errors
    /// Bad input: not a study, a key outside `[truth]`, or an unreadable file.
    pub fn read(file: Option<&Path>) -> Result<Uncertainty, Failure> {
        let Some(file) = file else {
            return Uncertainty::parse(STUDY, Path::new("built-in uncertainty.toml"), None);
        };
        let text = inputs::text::read(file)?;
        let points = Study::points_file(&text, file).map_err(Failure::bad_input)?;
        let points = points.map(|points| inputs::text::read(&output_file::folder_of(file).join(points)));
        Uncertainty::parse(&text, file, points.transpose()?.as_deref())
    }

    fn parse(text: &str, file: &Path, points: Option<&str>) -> Result<Uncertainty, Failure> {
        let study = Study::parse(text, file, points).map_err(Failure::bad_input)?;
        let name = file.display().to_string();
        let set = study.set.iter().map(|line| line.split('=').next().unwrap_or_default().trim());
        let is_other = |key: &&str| *key != "truth" && !key.starts_with("truth.");
        if let Some(key) = study.keys().into_iter().chain(set).find(is_other) {
            return Err(Failure::bad_input(format!(
                "{name}: `{key}` is not a key of `[truth]`, the only table that the study of a plan may set"
            )));
        }
        Ok(Uncertainty { study, name })
    }

    fn settings(&self, point: u64) -> Vec<String> {
        [self.study.set.clone(), self.study.point(point).settings()].concat()
    }

    /// Returns the number of worlds to run of `samples`.
    fn worlds(&self, samples: u64) -> u64 {
        samples.min(self.study.count())
    }

    /// Returns what is run in how many worlds, and whether the study limits them.
    pub fn progress(&self, plans: usize, samples: u64) -> String {
        let worlds = self.worlds(samples);
        let limit = match worlds < samples {
            true => format!(" instead of {samples}: {} has no more points", self.name),
            false => String::new(),
        };
        format!("running {}, each in {}{limit}", counted(plans, "plan"), counted(worlds, "sampled world"))
    }
}

/// Shares of sampled runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Risk {
    /// Runs in which the tool left the bone or entered a structure, of those with a result.
    pub breach: Proportion,
    /// Runs in which the target was missed, with those that were refused or failed, of all.
    pub miss: Proportion,
    /// Runs that were refused, for example because the arm would be in bone.
    pub refused: u64,
    /// Runs whose simulation failed.
    pub failed: u64,
    /// Why the first of these was refused or failed.
    pub reason: Option<String>,
}

impl Risk {
    fn of(outcomes: &[Outcome]) -> Risk {
        let count = |is_so: &dyn Fn(&Outcome) -> bool| outcomes.iter().filter(|it| is_so(it)).count() as u64;
        let has = |fault: Fault| count(&|outcome| outcome.fault == Some(fault));
        let (refused, failed) = (has(Fault::Refused), has(Fault::Failed));
        let all = outcomes.len() as u64;
        Risk {
            breach: Proportion {
                count: count(&|outcome| outcome.has_result() && outcome.is_breached),
                of: all - refused - failed,
            },
            miss: Proportion { count: count(&|outcome| outcome.is_missed), of: all },
            refused,
            failed,
            reason: outcomes.iter().find_map(|outcome| outcome.reason.clone()),
        }
    }

    /// Returns how many runs have no result and why; `None` if all have one.
    pub fn without_result(&self) -> Option<String> {
        let count = self.refused + self.failed;
        let reason = self.reason.as_deref().unwrap_or_default();
        (count > 0).then(|| format!("{count} of {}: {reason}", counted(self.miss.of, "sampled run")))
    }
}

impl Search<'_> {
    /// Refuses a study with keys that the scene does not have.
    ///
    /// # Errors
    /// Bad input (2).
    pub fn check(&self, uncertainty: &Uncertainty) -> Result<(), Failure> {
        let scene = changed(&self.source, &self.text).with(&uncertainty.settings(0));
        scene.and_then(|scene| scene.has_the_keys()).map_err(|failure| {
            // The keys are those of the study, not of the scene or the command line.
            let cause = failure.message.split_once("--set").map_or(&*failure.message, |(_, cause)| cause);
            Failure::bad_input(format!("{}: {}", uncertainty.name, cause.trim_start_matches([':', ' '])))
        })
    }

    /// Runs each plan in the first `samples` worlds.
    ///
    /// # Errors
    /// Bad input (2): all runs are refused; out of memory (1); Ctrl-C (130).
    pub fn risks(
        &self,
        plans: &[&Candidate],
        uncertainty: &Uncertainty,
        samples: u64,
    ) -> Result<Vec<Risk>, Failure> {
        let samples = uncertainty.worlds(samples);
        let all: Vec<(&str, u64)> =
            plans.iter().flat_map(|plan| (0..samples).map(|point| (plan.text.as_str(), point))).collect();
        let outcomes =
            on_all_cores("path", &all, |(text, point)| self.outcome(text, &uncertainty.settings(*point)))?;
        let of_plan = |index: usize| {
            let first = index * samples as usize;
            Risk::of(&outcomes[first..first + samples as usize])
        };
        let risks: Vec<Risk> = (0..plans.len()).map(of_plan).collect();
        match risks.first().and_then(|risk| risk.reason.as_ref()) {
            Some(reason) if risks.iter().all(|risk| risk.refused == samples) => Err(Failure::bad_input(
                format!("{}: all sampled runs are refused: {reason}", uncertainty.name),
            )),
            _ => Ok(risks),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_without_a_result_are_missed_but_say_nothing_of_a_breach() {
        let breached = Outcome { is_breached: true, fault: Some(Fault::Breach), ..Outcome::default() };
        let failed = Outcome {
            is_missed: true,
            fault: Some(Fault::Failed),
            reason: Some("it burst".to_owned()),
            ..breached.clone()
        };
        let refused = Outcome::refused("too far".to_owned());
        let risk = Risk::of(&[Outcome::default(), refused.clone(), breached, failed]);
        assert_eq!((risk.breach.count, risk.breach.of), (1, 2));
        assert_eq!((risk.miss.count, risk.miss.of), (2, 4));
        assert_eq!(risk.without_result().unwrap(), "2 of 4 sampled runs: too far");
        let risk = Risk::of(&[refused]);
        assert_eq!((risk.breach.of, risk.breach.interval()), (0, [0.0, 1.0]));
        assert_eq!(Risk::of(&[Outcome::default()]).without_result(), None);
    }

    #[test]
    fn a_study_sets_only_the_truth() {
        let study = |set: &str, key: &str| {
            let text = format!(
                "design = \"random\"\nsamples = 3\nset = [\"{set}\"]\n\
                 [[parameter]]\nkey = \"{key}\"\nmin = 0.0\nmax = 1.0\n"
            );
            Uncertainty::parse(&text, Path::new("mine.toml"), None)
        };
        let uncertainty = study("truth.bodies = []", "truth.manipulator.tendon_friction").unwrap();
        assert_eq!(uncertainty.progress(2, 3), "running 2 plans, each in 3 sampled worlds");
        assert_eq!(
            uncertainty.progress(1, 5),
            "running 1 plan, each in 3 sampled worlds instead of 5: mine.toml has no more points"
        );
        for (set, key, other) in [
            ("run.seed=3", "truth.manipulator.tendon_friction", "run.seed"),
            ("truth.manipulator.tendon_friction=0.1", "truths.x", "truths.x"),
        ] {
            let refused = study(set, key).err().unwrap();
            let expected = format!("mine.toml: `{other}` is not a key of `[truth]`");
            assert!(refused.code == 2 && refused.message.starts_with(&expected), "{}", refused.message);
        }
    }
}
