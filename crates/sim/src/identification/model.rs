//! Residuals of experiments: what the solver asks for.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use identify::signal::Trace;
use identify::study::{Commands, Target};
use identify::{Model, Outcome};

use super::IsToEnd;
use super::open::OpenedStudy;
use super::run::{Job, Traces, run_all};
use crate::error::SimError;

/// Rows of a measured column that are compared, or predicted.
#[derive(Debug, Clone)]
pub(super) struct Column {
    pub experiment: usize,
    pub measured: usize,
    pub column: usize,
    /// Rows within the measurement's rows.
    pub rows: Vec<usize>,
    /// Standard deviation of the noise, in the unit.
    pub noise: f64,
    /// Place of its residuals in the vector of all.
    pub place: Range<usize>,
}

/// Times and values of a measurement; a planned one has zeros.
#[derive(Debug, Clone)]
pub(super) struct Measurement {
    pub experiment: usize,
    pub measured: usize,
    pub times_s: Vec<f64>,
    pub values: Vec<Vec<f64>>,
}

/// Experiments as a model.
pub(super) struct ExperimentModel<'a> {
    pub study: &'a OpenedStudy,
    pub measurements: Vec<Measurement>,
    pub columns: Vec<Column>,
    /// Traces of the last request and the one before, by experiment and everything that a simulation depends
    /// on.
    kept: [BTreeMap<(usize, Vec<u64>), Traces>; 2],
    is_to_end: IsToEnd<'a>,
    /// Simulated ticks.
    pub ticks: u64,
}

impl<'a> ExperimentModel<'a> {
    /// Takes the experiments that a predicate selects. `noise` returns the standard deviation of a column
    /// by the indices of experiment, measured quantity and column.
    pub fn new(
        study: &'a OpenedStudy,
        select: impl Fn(usize) -> bool,
        noise: impl Fn(usize, usize, usize) -> f64,
        is_to_end: IsToEnd<'a>,
    ) -> ExperimentModel<'a> {
        let mut measurements = Vec::new();
        let mut columns = Vec::new();
        let mut place = 0;
        for (index, experiment) in study.study.experiments.iter().enumerate().filter(|(i, _)| select(*i)) {
            for (at, measured) in experiment.measured.iter().enumerate() {
                let measurement = measurement(study, index, at);
                for column in 0..measured.columns.len() {
                    let is_measured = |row: &usize| measurement.values[column][*row].is_finite();
                    let rows: Vec<usize> = (0..measurement.times_s.len()).filter(is_measured).collect();
                    if rows.is_empty() {
                        continue;
                    }
                    let range = place..place + rows.len();
                    place = range.end;
                    let noise = noise(index, at, column);
                    let (experiment, measured) = (index, at);
                    columns.push(Column { experiment, measured, column, rows, noise, place: range });
                }
                measurements.push(measurement);
            }
        }
        let kept = [BTreeMap::new(), BTreeMap::new()];
        ExperimentModel { study, measurements, columns, kept, is_to_end, ticks: 0 }
    }

    /// Returns the measurement of a column.
    pub fn measurement(&self, column: &Column) -> &Measurement {
        let is_its = |it: &&Measurement| (it.experiment, it.measured) == (column.experiment, column.measured);
        // Every column was made from one.
        self.measurements.iter().find(is_its).unwrap_or(&self.measurements[0])
    }

    /// Returns what the simulation of an experiment depends on: the values of scene keys and commands.
    fn key(&self, experiment: usize, values: &[f64]) -> (usize, Vec<u64>) {
        let commands = &self.study.study.experiments[experiment].commands;
        let matters = |target: &Target| match target {
            Target::Scene(_) => true,
            Target::Command { .. } => matches!(commands, Commands::Table(_)),
            _ => false,
        };
        let pairs = self.study.study.targets.iter().zip(values);
        (experiment, pairs.filter(|(target, _)| matters(target)).map(|(_, value)| value.to_bits()).collect())
    }

    fn experiments(&self) -> Vec<usize> {
        let mut experiments: Vec<usize> = self.measurements.iter().map(|it| it.experiment).collect();
        experiments.dedup();
        experiments
    }

    /// Simulates what is not known yet.
    fn simulate(&mut self, points: &[Vec<f64>]) -> Result<(), SimError> {
        let mut wanted: BTreeMap<(usize, Vec<u64>), Traces> = BTreeMap::new();
        let mut jobs: Vec<((usize, Vec<u64>), Job)> = Vec::new();
        for values in points {
            for experiment in self.experiments() {
                let key = self.key(experiment, values);
                if wanted.contains_key(&key) || jobs.iter().any(|(other, _)| *other == key) {
                    continue;
                }
                match self.kept.iter().find_map(|kept| kept.get(&key)) {
                    Some(known) => _ = wanted.insert(key, known.clone()),
                    None => jobs.push((key, Job { experiment, values: values.clone() })),
                }
            }
        }
        let (keys, jobs): (Vec<_>, Vec<Job>) = jobs.into_iter().unzip();
        self.ticks += jobs.iter().map(|job| self.study.experiments[job.experiment].ticks).sum::<u64>();
        let traces = run_all(self.study, &jobs, self.is_to_end)?;
        wanted.extend(keys.into_iter().zip(traces));
        let last = std::mem::replace(&mut self.kept[0], wanted);
        self.kept[1] = last;
        Ok(())
    }

    /// Returns the simulated values of a column in its unit, as the sensor reports them, at each of its rows.
    fn reported(&self, column: &Column, traces: &[Trace], values: &[f64]) -> Vec<f64> {
        let measured = &self.study.study.experiments[column.experiment].measured[column.measured];
        let (offset_s, signal) = self.study.study.signal(column.experiment, measured, values);
        let measurement = self.measurement(column);
        let mut sample = Vec::new();
        let mut reported = Vec::with_capacity(column.rows.len());
        for row in &column.rows {
            sample.clear();
            traces[column.measured].at(measurement.times_s[*row] - offset_s - signal.delay_s, &mut sample);
            signal.report(measured.shape, measured.unit, &mut sample);
            reported.push(sample[column.column]);
        }
        reported
    }

    /// Returns the residuals at a point whose simulations are known.
    fn assembled(&self, values: &[f64]) -> Outcome {
        let mut residuals = Vec::new();
        for column in &self.columns {
            let key = self.key(column.experiment, values);
            let traces: Option<&Traces> = self.kept[0].get(&key);
            let traces: &Arc<Vec<Trace>> = match traces {
                Some(Ok(traces)) => traces,
                Some(Err(reason)) => return Err(reason.clone()),
                None => return Err("not simulated".to_owned()),
            };
            let measured = &self.measurement(column).values[column.column];
            let reported = self.reported(column, traces, values);
            let pairs = reported.iter().zip(&column.rows);
            residuals.extend(pairs.map(|(simulated, row)| (simulated - measured[*row]) / column.noise));
        }
        Ok(residuals)
    }
}

impl Model for ExperimentModel<'_> {
    type Error = SimError;

    fn residuals(&mut self, points: &[Vec<f64>]) -> Result<Vec<Outcome>, SimError> {
        self.simulate(points)?;
        Ok(points.iter().map(|values| self.assembled(values)).collect())
    }
}

/// Returns a measurement's rows, or the planned times of one without a file.
fn measurement(study: &OpenedStudy, experiment: usize, at: usize) -> Measurement {
    let opened = &study.experiments[experiment];
    let measured = &study.study.experiments[experiment].measured[at];
    if measured.source.is_some()
        && let Some((rows, _)) = opened.data.get(at)
    {
        let (times_s, values) = (rows.times_s.clone(), rows.columns.clone());
        return Measurement { experiment, measured: at, times_s, values };
    }
    let times_s = planned_times_s(study, experiment, at);
    let column = |name: &String| {
        let value = if name.is_empty() { f64::NAN } else { 0.0 };
        vec![value; times_s.len()]
    };
    let values = measured.columns.iter().map(column).collect();
    Measurement { experiment, measured: at, times_s, values }
}

/// Returns the times at which a sensor with `rate_hz` reports during an experiment, on the clock of its file.
pub(super) fn planned_times_s(study: &OpenedStudy, experiment: usize, at: usize) -> Vec<f64> {
    let (opened, planned) = (&study.experiments[experiment], &study.study.experiments[experiment]);
    let measured = &planned.measured[at];
    let end_s = opened.ticks as f64 * opened.shared.scene().dt_s();
    let rate_hz = measured.rate_hz.unwrap_or(0.0);
    let offset_s = planned.clock_offset_s + measured.signal.delay_s;
    let count = if rate_hz > 0.0 { (end_s * rate_hz + 1e-9) as usize + 1 } else { 0 };
    (0..count).map(|i| i as f64 / rate_hz + offset_s).collect()
}
