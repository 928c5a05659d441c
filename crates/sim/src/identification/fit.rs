//! The fit of a study, its check, and the ranking of candidates.

use std::collections::BTreeMap;

use identify::study::{Role, Target};
use identify::wording::undetermined;
use identify::{
    Bound, Fit, Method, Model, Parameter, ResidualStatistics, SolveError, Stop, Uncertainty, expected_sd,
    gram, information, linearised, rank,
};
use inputs::failure::Failure;

use super::IsToEnd;
use super::model::{Column, ExperimentModel};
use super::open::{OpenedStudy, lookup};
use super::predict::{Band, NORMAL_QUANTILE, linear_sd, sampled_half_widths};
use super::result::{
    CandidateReport, CheckReport, ColumnReport, DesignReport, ExperimentReport, FitReport, MeasuredReport,
    ParameterReport, Series,
};
use crate::error::SimError;

/// Largest relative change of an estimated noise at which its estimation ends.
const NOISE_CHANGE: f64 = 0.01;
/// Maximum number of fits for it.
const NOISE_ROUNDS: usize = 6;
/// Root mean square derivative, in noise per range, below which no parameter moves a column.
const UNMOVED: f64 = 1e-3;
/// Factor on the noise from which residuals are called larger than the noise.
pub const STANDARD_MARGIN: f64 = 1.1;

/// Noise of columns without a stated one, by sensor and column.
type EstimatedNoise = BTreeMap<(String, usize), f64>;

/// A fit with its model.
struct Fitted<'a> {
    model: ExperimentModel<'a>,
    fit: Fit,
    noise: EstimatedNoise,
    uncertainty: Uncertainty,
    evaluations: u64,
    ticks: u64,
}

fn solved(error: SolveError<SimError>) -> SimError {
    match error {
        SolveError::Model(error) => error,
        SolveError::Start { reason } => {
            Failure::bad_input(format!("the experiments cannot be simulated at the starting point: {reason}")).into()
        }
        SolveError::Derivative { key, reason } => Failure::bad_input(format!(
            "the experiments cannot be simulated beside a point, so `{key}` has no derivative there; narrow its \
             range: {reason}"
        ))
        .into(),
    }
}

fn role_name(role: Role) -> &'static str {
    match role {
        Role::Fitted => "fitted",
        Role::HeldOut => "held_out",
        Role::Predicted => "predicted",
        Role::Candidate => "candidate",
    }
}

impl OpenedStudy {
    fn role(&self, experiment: usize) -> Role {
        self.study.experiments[experiment].role
    }

    fn noise(
        &self,
        estimated: &EstimatedNoise,
        (experiment, measured, column): (usize, usize, usize),
    ) -> f64 {
        let measured = &self.study.experiments[experiment].measured[measured];
        let stated = measured.noise.as_ref().map(|noise| noise[column]);
        let key = (measured.name.clone(), column);
        stated.or_else(|| estimated.get(&key).copied()).unwrap_or(1.0)
    }

    fn model<'a>(
        &'a self,
        roles: &[Role],
        noise: &EstimatedNoise,
        is_to_end: IsToEnd<'a>,
    ) -> ExperimentModel<'a> {
        let of = |experiment, measured, column| self.noise(noise, (experiment, measured, column));
        ExperimentModel::new(self, |experiment| roles.contains(&self.role(experiment)), of, is_to_end)
    }

    /// Returns a first noise for columns without a stated one: a tenth of their standard deviation.
    fn first_noise(&self) -> EstimatedNoise {
        let mut noise = EstimatedNoise::new();
        for (experiment, opened) in self.study.experiments.iter().zip(&self.experiments) {
            for (measured, (rows, _)) in experiment.measured.iter().zip(&opened.data) {
                if measured.noise.is_some() || experiment.role != Role::Fitted {
                    continue;
                }
                for (column, values) in rows.columns.iter().enumerate() {
                    let there: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
                    let mean = there.iter().sum::<f64>() / there.len().max(1) as f64;
                    let square = there.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>();
                    let sd = (square / there.len().max(1) as f64).sqrt();
                    let first = if sd > 0.0 { 0.1 * sd } else { 1.0 };
                    noise.entry((measured.name.clone(), column)).or_insert(first);
                }
            }
        }
        noise
    }

    /// Fits the parameters, and the noise where it is not stated.
    fn fitted<'a>(&'a self, is_to_end: IsToEnd<'a>) -> Result<Fitted<'a>, SimError> {
        if !self.study.experiments.iter().any(|experiment| experiment.role == Role::Fitted) {
            let why = "no experiment has measurements to fit; expected one that is neither held out nor a \
                       candidate";
            return Err(Failure::bad_input(why).into());
        }
        let mut noise = self.first_noise();
        let (mut start, mut method) = (self.start.clone(), self.study.method);
        let (mut evaluations, mut ticks, mut round) = (0, 0, 0);
        let mut first: Option<Fit> = None;
        loop {
            let mut model = self.model(&[Role::Fitted], &noise, is_to_end);
            let found = identify::fit(&mut model, &self.study.parameters, &start, method).map_err(solved)?;
            evaluations += found.evaluations;
            ticks += model.ticks;
            round += 1;
            let next = self.estimated_noise(&model, &found);
            let change = next.iter().map(|(key, sd)| (sd / noise.get(key).unwrap_or(sd) - 1.0).abs());
            let is_settled = change.fold(0.0, f64::max) < NOISE_CHANGE;
            start.clone_from(&found.best.unit);
            if is_settled || round == NOISE_ROUNDS {
                let series: Vec<_> = model.columns.iter().map(|column| column.place.clone()).collect();
                let uncertainty = Uncertainty::of(&self.study.parameters, &found.best, &series);
                let costs = first.map_or(found.costs.clone(), |first| first.costs);
                let fit = Fit { costs, ..found };
                return Ok(Fitted { model, fit, noise, uncertainty, evaluations, ticks });
            }
            first.get_or_insert(found);
            method.starts = 1;
            noise = next;
        }
    }

    /// Estimates the noise of columns without a stated one from their residuals, less the share of the
    /// degrees of freedom that the parameters take.
    fn estimated_noise(&self, model: &ExperimentModel<'_>, fit: &Fit) -> EstimatedNoise {
        let mut sums: BTreeMap<(String, usize), (f64, f64)> = BTreeMap::new();
        for column in &model.columns {
            let measured = &self.study.experiments[column.experiment].measured[column.measured];
            if measured.noise.is_none() {
                let residuals = &fit.best.residuals[column.place.clone()];
                let weights = &fit.best.weights[column.place.clone()];
                let square: f64 = residuals.iter().zip(weights).map(|(r, w)| w * r * r).sum();
                let sum = sums.entry((measured.name.clone(), column.column)).or_default();
                sum.0 += square * column.noise * column.noise;
                sum.1 += residuals.len() as f64;
            }
        }
        let all = fit.best.residuals.len() as f64;
        let taken = self.study.parameters.len() as f64 / all;
        let sd = |(square, count): (f64, f64)| {
            (square / (count * (1.0 - taken).max(0.1))).sqrt().max(f64::MIN_POSITIVE)
        };
        sums.into_iter().map(|(key, sum)| (key, sd(sum))).collect()
    }

    /// Fits the study.
    ///
    /// # Errors
    /// Bad input: the experiments cannot be simulated at the start or beside a point;
    /// [`SimError::GivenUp`] on request; a failure of the machine.
    pub fn identify(&self, is_to_end: IsToEnd<'_>) -> Result<FitReport, SimError> {
        let mut fitted = self.fitted(is_to_end)?;
        let parameters = &self.study.parameters;
        let best = fitted.fit.best.clone();
        let covariance = fitted.uncertainty.covariance.clone();
        let mut series = Vec::new();
        let mut reports = Vec::new();
        let sd = linear_sd(&fitted.model, &best.columns, &covariance);
        let errors = self.model_errors(&fitted);
        self.report(&fitted.model, &best.residuals, &sd, None, &fitted, &errors, (&mut reports, &mut series));
        let mut others = self.model(&[Role::HeldOut, Role::Predicted], &fitted.noise, is_to_end);
        if !others.columns.is_empty() {
            let linear = linearised(&mut others, parameters, &best.unit, &best.steps).map_err(solved)?;
            let sd = linear_sd(&others, &linear.1, &covariance);
            let by = (self.study.draws, self.study.method.seed);
            let sampled = sampled_half_widths(&mut others, parameters, &best.unit, &covariance, by)?;
            let out = (&mut reports, &mut series);
            self.report(&others, &linear.0, &sd, Some(&sampled), &fitted, &errors, out);
            fitted.evaluations += 1 + 2 * parameters.len() as u64 + by.0 as u64;
            fitted.ticks += others.ticks;
        }
        let order = |report: &ExperimentReport| {
            self.study.experiments.iter().position(|experiment| experiment.name == report.name)
        };
        reports.sort_by_key(order);
        let (toml, settings) = self.pasted(&best.values)?;
        let slopes: Vec<f64> =
            parameters.iter().zip(&best.unit).map(|(parameter, unit)| parameter.slope(*unit)).collect();
        let scaled = |i: usize, j: usize| covariance[(i, j)] * slopes[i] * slopes[j];
        let uncertainty = &fitted.uncertainty;
        Ok(FitReport {
            parameters: self.parameter_reports(&fitted),
            covariance: rows(parameters.len(), scaled),
            correlation: rows(parameters.len(), |i, j| uncertainty.correlation[(i, j)]),
            undetermined: undetermined(parameters, uncertainty),
            cautions: self.cautions(&fitted, &reports),
            stop: best.stop,
            iterations: best.iterations,
            evaluations: fitted.evaluations,
            simulated_s: fitted.ticks as f64 * self.experiments[0].shared.scene().dt_s(),
            cost: [fitted.fit.first_cost, best.cost],
            costs: fitted.fit.costs.clone(),
            reduced_chi_square: uncertainty.reduced_chi_square,
            residual_count: best.residuals.len(),
            experiments: reports,
            toml,
            settings,
            series,
        })
    }

    fn parameter_reports(&self, fitted: &Fitted<'_>) -> Vec<ParameterReport> {
        let best = &fitted.fit.best;
        let report = |(j, parameter): (usize, &identify::Parameter)| {
            let estimate = &fitted.uncertainty.estimates[j];
            ParameterReport {
                key: parameter.key.clone(),
                value: estimate.value,
                sd: estimate.sd.filter(|_| best.at_bound[j].is_none()),
                interval: estimate.interval,
                is_determined: estimate.is_determined,
                at_bound: best.at_bound[j],
                start: parameter.value(self.start[j]),
                range: [parameter.min, parameter.max],
            }
        };
        self.study.parameters.iter().enumerate().map(report).collect()
    }

    /// Returns the error of the model for each sensor's column: residuals of the fit beyond the noise, in the
    /// unit.
    fn model_errors(&self, fitted: &Fitted<'_>) -> EstimatedNoise {
        let mut errors = EstimatedNoise::new();
        for (column, statistics) in fitted.model.columns.iter().zip(&fitted.uncertainty.series) {
            let measured = &self.study.experiments[column.experiment].measured[column.measured];
            // With an estimated noise, all of a correlated residual may be the model's.
            let noise = if measured.noise.is_some() { 1.0 } else { 0.0 };
            let beyond = (statistics.rms * statistics.rms - noise).max(0.0).sqrt() * column.noise;
            let error = if statistics.inflation > 1.0 { beyond } else { 0.0 };
            let known = errors.entry((measured.name.clone(), column.column)).or_insert(0.0);
            *known = known.max(error);
        }
        errors
    }

    /// Adds the reports and series of a model's experiments.
    #[allow(clippy::too_many_arguments, reason = "a model's residuals, bands and where they go")]
    fn report(
        &self,
        model: &ExperimentModel<'_>,
        residuals: &[f64],
        sd: &[f64],
        sampled: Option<&[f64]>,
        fitted: &Fitted<'_>,
        errors: &EstimatedNoise,
        (reports, all): (&mut Vec<ExperimentReport>, &mut Vec<Series>),
    ) {
        for column in &model.columns {
            let experiment = &self.study.experiments[column.experiment];
            let measured = &experiment.measured[column.measured];
            let is_measured = experiment.role != Role::Predicted;
            let name = &measured.columns[column.column];
            let own = &residuals[column.place.clone()];
            let error = errors.get(&(measured.name.clone(), column.column)).copied().unwrap_or(0.0);
            let sd = &sd[column.place.clone()];
            let series = series(model, column, own, sd, error, is_measured, (experiment, measured));
            let limit = |sd: &f64| NORMAL_QUANTILE * (sd * sd + column.noise * column.noise).sqrt();
            let inside = own.iter().zip(&series.sd).filter(|(r, sd)| (**r * column.noise).abs() <= limit(sd));
            let share = inside.count() as f64 / own.len() as f64;
            let sampled = sampled.map(|half| {
                half[column.place.clone()].iter().map(|half| half * column.noise).fold(0.0, f64::max)
            });
            let statistics = fitted_statistics(fitted, column).unwrap_or_else(|| ResidualStatistics::of(own));
            let report = ColumnReport {
                name: name.clone(),
                noise: column.noise,
                noise_is_estimated: measured.noise.is_none(),
                rms: is_measured.then_some(rms(own) * column.noise),
                residuals: is_measured.then_some(statistics),
                band: Band {
                    linear: NORMAL_QUANTILE * sd.iter().copied().fold(0.0, f64::max),
                    sampled,
                    model: NORMAL_QUANTILE * error,
                    coverage: is_measured.then_some(share),
                },
            };
            all.push(series);
            self.experiment_report(reports, column, report);
        }
    }

    /// Adds a column's report to that of its experiment.
    fn experiment_report(&self, reports: &mut Vec<ExperimentReport>, column: &Column, report: ColumnReport) {
        let (experiment, opened) =
            (&self.study.experiments[column.experiment], &self.experiments[column.experiment]);
        let measured = &experiment.measured[column.measured];
        if reports.last().is_none_or(|last| last.name != experiment.name) {
            reports.push(ExperimentReport {
                name: experiment.name.clone(),
                role: role_name(experiment.role),
                simulated_s: opened.ticks as f64 * opened.shared.scene().dt_s(),
                measured: Vec::new(),
            });
        }
        let Some(of_experiment) = reports.last_mut() else { return };
        if of_experiment.measured.last().is_none_or(|last| last.name != measured.name) {
            of_experiment.measured.push(MeasuredReport {
                name: measured.name.clone(),
                unit: measured.unit_name.clone(),
                rows: opened.data.get(column.measured).map_or_else(Default::default, |(_, count)| *count),
                columns: Vec::new(),
            });
        }
        if let Some(of_measured) = of_experiment.measured.last_mut() {
            of_measured.columns.push(report);
        }
    }

    /// Returns what deserves attention.
    fn cautions(&self, fitted: &Fitted<'_>, reports: &[ExperimentReport]) -> Vec<String> {
        let mut said = Vec::new();
        let best = &fitted.fit.best;
        for (parameter, bound) in self.study.parameters.iter().zip(&best.at_bound) {
            if let Some(bound) = bound {
                let (name, value) = match bound {
                    Bound::Min => ("min", parameter.min),
                    Bound::Max => ("max", parameter.max),
                };
                said.push(format!(
                    "`{}` is at its `{name}`, {value}: the optimum lies outside its range, and the other \
                     estimates hold only for this value",
                    parameter.key
                ));
            }
        }
        match best.stop {
            Stop::Converged => {}
            Stop::Rough => said.push(
                "the fit ended where the simulation is not smooth on the scale of `step`; set a larger `step` for \
                 parameters of drilled bone, a smaller one otherwise, or compare several `starts`"
                    .to_owned(),
            ),
            Stop::Iterations => {
                said.push("the fit has not converged within `iterations`; the intervals do not hold".to_owned());
            }
        }
        let reached = fitted.fit.costs.iter().flatten();
        let worse = reached.filter(|cost| **cost > best.cost * 1.01 + 1.0).count();
        if worse > 0 {
            said.push(format!(
                "{worse} of {} starting points led to a worse optimum",
                fitted.fit.costs.len()
            ));
        }
        for column in &fitted.model.columns {
            let moved = best.columns.iter().map(|derivative| rms(&derivative[column.place.clone()]));
            if moved.fold(0.0, f64::max) < UNMOVED {
                let experiment = &self.study.experiments[column.experiment];
                let measured = &experiment.measured[column.measured];
                said.push(format!(
                    "experiment `{}`: no parameter moves column `{}` of `{}`",
                    experiment.name, measured.columns[column.column], measured.name
                ));
            }
        }
        said.extend(reports.iter().flat_map(residual_cautions));
        said
    }

    /// Returns the estimated scene keys as TOML, and as settings.
    fn pasted(&self, values: &[f64]) -> Result<(String, Vec<String>), SimError> {
        let settings = [self.arrays.clone(), self.study.settings(values)].concat();
        let scene = self.scene_table()?;
        let mut table = toml::Table::new();
        for (target, value) in self.study.targets.iter().zip(values) {
            let Target::Scene(key) = target else { continue };
            place(&mut table, &scene, key, *value);
        }
        let text = toml::to_string(&table).map_err(|cause| SimError::SceneText(cause.to_string()))?;
        Ok((text, settings))
    }

    /// Compares once, at the starting point.
    ///
    /// # Errors
    /// As [`OpenedStudy::identify`].
    pub fn check(&self, is_to_end: IsToEnd<'_>) -> Result<CheckReport, SimError> {
        let noise = self.first_noise();
        let mut model = self.model(&[Role::Fitted, Role::HeldOut], &noise, is_to_end);
        let parameters = &self.study.parameters;
        let values: Vec<f64> =
            parameters.iter().zip(&self.start).map(|(parameter, unit)| parameter.value(*unit)).collect();
        let outcome = model.residuals(std::slice::from_ref(&values))?.pop();
        let residuals = match outcome {
            Some(Ok(residuals)) => residuals,
            Some(Err(reason)) => return Err(solved(SolveError::Start { reason })),
            None => Vec::new(),
        };
        let mut reports = Vec::new();
        for column in &model.columns {
            let measured = &self.study.experiments[column.experiment].measured[column.measured];
            let own = &residuals[column.place.clone()];
            let report = ColumnReport {
                name: measured.columns[column.column].clone(),
                noise: column.noise,
                noise_is_estimated: measured.noise.is_none(),
                rms: Some(rms(own) * column.noise),
                residuals: Some(ResidualStatistics::of(own)),
                band: Band::default(),
            };
            self.experiment_report(&mut reports, column, report);
        }
        let mut notes: Vec<String> = Vec::new();
        for note in self.experiments.iter().flat_map(|opened| opened.shared.notes()) {
            if !notes.contains(note) {
                notes.push(note.clone());
            }
        }
        let start = parameters.iter().zip(values).map(|(parameter, value)| (parameter.key.clone(), value));
        Ok(CheckReport {
            parameters: parameters.len(),
            residual_count: residuals.len(),
            start: start.collect(),
            mean_square: rms(&residuals).powi(2),
            experiments: reports,
            notes,
        })
    }

    /// Ranks the candidate experiments by their expected information, at the fit of the others or, without
    /// measurements, at the starting point.
    ///
    /// # Errors
    /// As [`OpenedStudy::identify`]; bad input if there is no candidate.
    pub fn plan(&self, is_to_end: IsToEnd<'_>) -> Result<DesignReport, SimError> {
        let count = self.study.experiments.len();
        let candidates: Vec<usize> = (0..count).filter(|i| self.role(*i) == Role::Candidate).collect();
        if candidates.is_empty() {
            let why = "no experiment is a candidate; set `candidate = true` for those to choose from";
            return Err(Failure::bad_input(why).into());
        }
        let parameters = &self.study.parameters;
        let has_data = self.study.experiments.iter().any(|experiment| experiment.role == Role::Fitted);
        let (unit, steps, present, noise) = match has_data {
            true => {
                let mut fitted = self.fitted(is_to_end)?;
                let best = &fitted.fit.best;
                // By the differences that the candidates get, so that roughness counts alike.
                let (_, columns) =
                    linearised(&mut fitted.model, parameters, &best.unit, &best.steps).map_err(solved)?;
                let present = information(parameters, &best.unit, &columns, &best.weights);
                (best.unit.clone(), best.steps.clone(), present, fitted.noise)
            }
            false => {
                let none = vec![Vec::new(); parameters.len()];
                let present = information(parameters, &self.start, &none, &[]);
                let steps = parameters.iter().map(Parameter::difference).collect();
                (self.start.clone(), steps, present, EstimatedNoise::new())
            }
        };
        let mut more = Vec::new();
        for &candidate in &candidates {
            let of = |experiment, measured, column| self.noise(&noise, (experiment, measured, column));
            let mut model = ExperimentModel::new(self, |experiment| experiment == candidate, of, is_to_end);
            let (residuals, columns) = linearised(&mut model, parameters, &unit, &steps).map_err(solved)?;
            more.push(gram(&columns, &vec![1.0; residuals.len()]));
        }
        let half_width = |sd: Vec<f64>| -> Vec<f64> {
            let slopes = parameters.iter().zip(&unit).map(|(parameter, unit)| parameter.slope(*unit));
            sd.iter().zip(slopes).map(|(sd, slope)| NORMAL_QUANTILE * sd * slope).collect()
        };
        let gains = rank(&present, &more).into_iter().map(|gain| CandidateReport {
            name: self.study.experiments[candidates[gain.candidate]].name.clone(),
            half_widths: half_width(gain.sd),
            volume: gain.volume,
        });
        Ok(DesignReport {
            parameters: parameters.iter().map(|parameter| parameter.key.clone()).collect(),
            values: parameters.iter().zip(&unit).map(|(parameter, unit)| parameter.value(*unit)).collect(),
            half_widths: half_width(expected_sd(&present)),
            candidates: gains.collect(),
        })
    }

    /// Returns the method, for reports.
    pub fn method(&self) -> Method {
        self.study.method
    }
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|x| x * x).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

fn rows(count: usize, of: impl Fn(usize, usize) -> f64) -> Vec<Vec<f64>> {
    (0..count).map(|i| (0..count).map(|j| of(i, j)).collect()).collect()
}

/// Returns the statistics of a fitted column, which weigh outliers as the fit did.
fn fitted_statistics(fitted: &Fitted<'_>, column: &Column) -> Option<ResidualStatistics> {
    let is_its = |other: &Column| {
        (other.experiment, other.measured, other.column)
            == (column.experiment, column.measured, column.column)
    };
    let index = fitted.model.columns.iter().position(is_its)?;
    fitted.uncertainty.series.get(index).copied()
}

fn series(
    model: &ExperimentModel<'_>,
    column: &Column,
    residuals: &[f64],
    sd: &[f64],
    error: f64,
    is_measured: bool,
    (experiment, measured): (&identify::study::Experiment, &identify::study::Measured),
) -> Series {
    let measurement = model.measurement(column);
    let values = &measurement.values[column.column];
    let rows = column.rows.iter();
    Series {
        experiment: experiment.name.clone(),
        role: role_name(experiment.role),
        sensor: measured.name.clone(),
        column: measured.columns[column.column].clone(),
        unit: measured.unit_name.clone(),
        times_s: rows.clone().map(|row| measurement.times_s[*row]).collect(),
        measured: if is_measured { rows.clone().map(|row| values[*row]).collect() } else { Vec::new() },
        simulated: rows.zip(residuals).map(|(row, r)| values[*row] + r * column.noise).collect(),
        sd: sd.iter().map(|sd| (sd * sd + error * error).sqrt()).collect(),
        noise: column.noise,
    }
}

/// Returns what the residuals of an experiment show.
fn residual_cautions(report: &ExperimentReport) -> Vec<String> {
    let mut said = Vec::new();
    let name = &report.name;
    for measured in &report.measured {
        let rows = measured.rows;
        if rows.outside > 0 {
            said.push(format!(
                "experiment `{name}`: {} of {} rows of `{}` lie outside the simulated time",
                rows.outside, rows.rows, measured.name
            ));
        }
        if rows.gaps > 0 {
            said.push(format!(
                "experiment `{name}`: `{}` has {} gaps of more than five of its intervals",
                measured.name, rows.gaps
            ));
        }
        for column in &measured.columns {
            let Some(residuals) = column.residuals else { continue };
            let place = format!("experiment `{name}`: residuals of `{}` of `{}`", column.name, measured.name);
            if !residuals.is_white {
                said.push(format!(
                    "{place} are not white: neighbours correlate by {:.2}, so the model leaves a part \
                     unexplained; intervals are widened for it",
                    residuals.lag_one
                ));
            }
            if residuals.rms > STANDARD_MARGIN && !column.noise_is_estimated && residuals.inflation > 1.0 {
                said.push(format!("{place} are {:.1} times the stated noise", residuals.rms));
            }
        }
    }
    said
}

/// Puts a value at a key's path of a table; arrays are taken from the scene.
fn place(table: &mut toml::Table, scene: &toml::Table, key: &str, value: f64) {
    let parts: Vec<&str> = key.split('.').collect();
    let mut at = table;
    for (depth, part) in parts.iter().enumerate() {
        if depth + 1 == parts.len() {
            at.insert((*part).to_owned(), toml::Value::Float(value));
            return;
        }
        let path = parts[..=depth].join(".");
        if let Ok(index) = parts[depth + 1].parse::<usize>() {
            let known = lookup(scene, &path).and_then(toml::Value::as_array).cloned();
            let zeros = || vec![toml::Value::Float(0.0); 3];
            let array = at
                .entry((*part).to_owned())
                .or_insert_with(|| toml::Value::Array(known.unwrap_or_else(zeros)));
            let Some(element) = array.as_array_mut().and_then(|array| array.get_mut(index)) else { return };
            match element {
                toml::Value::Table(below) if depth + 2 < parts.len() => {
                    place(below, &toml::Table::new(), &parts[depth + 2..].join("."), value);
                }
                _ => *element = toml::Value::Float(value),
            }
            return;
        }
        let below = at.entry((*part).to_owned()).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        let toml::Value::Table(below) = below else { return };
        at = below;
    }
}
