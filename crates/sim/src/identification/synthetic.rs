//! Synthetic measurements of a scene, for planning an experiment.

use std::path::Path;

use counter_random::Key;
use identify::study::Commands;

use super::IsToEnd;
use super::model::planned_times_s;
use super::open::OpenedStudy;
use super::run::{Job, simulated};
use crate::error::SimError;

/// A file of synthetic measurements.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SyntheticFile {
    /// File name: experiment and sensor.
    pub name: String,
    /// Its text.
    pub csv: String,
}

impl OpenedStudy {
    /// Simulates every experiment with its scene as it is, `[truth]` included, and returns what its
    /// sensors report at their `rate_hz`, with noise, as CSV: a column `time_s`, then the columns of the
    /// study. Parameters have no effect. An experiment that the scene's own controllers drive is also
    /// recorded, into `FOLDER/NAME`, so that its commands can be named as a log.
    ///
    /// # Errors
    /// Bad input: a sensor has no `rate_hz` or no noise; as [`OpenedStudy::identify`].
    pub fn simulate(&self, folder: &Path, is_to_end: IsToEnd<'_>) -> Result<Vec<SyntheticFile>, SimError> {
        let mut files = Vec::new();
        self.refuse_incomplete()?;
        for (index, experiment) in self.study.experiments.iter().enumerate() {
            let is_own = matches!(experiment.commands, Commands::Scene);
            let mut record = |sim: &mut crate::Sim| match is_own {
                true => sim.record(&folder.join(&experiment.name)),
                false => Ok(()),
            };
            // Without values, no parameter is set.
            let job = Job { experiment: index, values: Vec::new() };
            let traces = simulated(self, &job, is_to_end, &mut record)?;
            for (at, measured) in experiment.measured.iter().enumerate() {
                let columns: Vec<&String> = measured.columns.iter().filter(|name| !name.is_empty()).collect();
                let header = columns.iter().map(|name| name.as_str()).collect::<Vec<_>>().join(",");
                let mut csv = format!("time_s,{header}\n");
                let key = Key::of(u64::from(self.study.method.seed)).and(index as u64).and(at as u64);
                let mut counter = 0;
                for time_s in planned_times_s(self, index, at) {
                    let mut values = Vec::new();
                    let seen_s = time_s - experiment.clock_offset_s - measured.signal.delay_s;
                    traces[at].at(seen_s, &mut values);
                    measured.signal.report(measured.shape, measured.unit, &mut values);
                    csv.push_str(&format!("{time_s:?}"));
                    let noise = measured.noise.as_deref().unwrap_or_default();
                    for (column, (value, name)) in values.iter().zip(&measured.columns).enumerate() {
                        if name.is_empty() {
                            continue;
                        }
                        let error = noise.get(column).copied().unwrap_or(0.0) * key.normal(counter);
                        counter += 1;
                        csv.push_str(&format!(",{:?}", value + error));
                    }
                    csv.push('\n');
                }
                files.push(SyntheticFile { name: file_name(&experiment.name, &measured.name), csv });
            }
        }
        Ok(files)
    }

    /// Returns the names of the files of [`OpenedStudy::simulate`].
    pub fn synthetic_names(&self) -> Vec<String> {
        let of = |experiment: &identify::study::Experiment| {
            let name = |measured: &identify::study::Measured| file_name(&experiment.name, &measured.name);
            experiment.measured.iter().map(name).collect::<Vec<_>>()
        };
        self.study.experiments.iter().flat_map(of).collect()
    }

    fn refuse_incomplete(&self) -> Result<(), SimError> {
        for experiment in &self.study.experiments {
            for measured in &experiment.measured {
                let lacks = match () {
                    () if measured.rate_hz.is_none() => "rate_hz",
                    () if measured.noise.is_none() => "noise",
                    () => continue,
                };
                return Err(inputs::failure::Failure::bad_input(format!(
                    "experiment `{}`: `{}` needs `{lacks}` to be simulated",
                    experiment.name, measured.name
                ))
                .into());
            }
        }
        Ok(())
    }
}

fn file_name(experiment: &str, sensor: &str) -> String {
    format!("{experiment}_{sensor}.csv")
}
