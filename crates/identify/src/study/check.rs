//! Parses and checks a study.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use foreign_text::nearest_name;
use messages::layout::Message;
use messages::{ArmMode, BurrMode, Command, MAX_JOINTS, TendonMode, TubeMode};
use sweep::{Scale, StudyError};

use super::target::{SignalPart, Target};
use super::text::{CommandsText, ExperimentText, Loss, MeasuredText, Text};
use super::{
    ColumnOrValue, CommandColumn, CommandTable, Commands, Experiment, MAX_DRAWS, MAX_EXPERIMENTS,
    MAX_MEASURED, MAX_PARAMETERS, MAX_STARTS, Measured, Role, Source, Study,
};
use crate::parameter::Parameter;
use crate::quantity::{Body, Frame, Kind, Quantity};
use crate::signal::{Shape, Signal};
use crate::solver::Method;
use crate::unit::Dimension;

/// Residual from which Huber's loss grows linearly: 95 % efficiency for normal noise (Huber 1981, "Robust
/// Statistics").
const STANDARD_HUBER_SD: f64 = 1.345;
/// Steps from each starting point.
const STANDARD_ITERATIONS: u32 = 50;
/// Draws of a prediction band.
const STANDARD_DRAWS: usize = 32;

/// Builds the errors of a file.
struct Checker<'a> {
    file: &'a Path,
}

impl Checker<'_> {
    fn value(&self, key: String, given: impl ToString, expected: impl ToString) -> StudyError {
        StudyError::Value {
            file: self.file.to_owned(),
            key,
            given: given.to_string(),
            expected: expected.to_string(),
        }
    }

    fn conflict(&self, key: String, problem: impl ToString) -> StudyError {
        StudyError::Contradiction { file: self.file.to_owned(), key, problem: problem.to_string() }
    }

    fn finite(&self, key: &str, value: f64, low: f64, high: f64) -> Result<f64, StudyError> {
        match (low..=high).contains(&value) {
            true => Ok(value),
            false => Err(self.value(key.to_owned(), value, format!("{low} to {high}"))),
        }
    }
}

pub(super) fn study(text: &str, file: &Path) -> Result<Study, StudyError> {
    let read: Text = toml::from_str(text).map_err(|error| {
        let line = foreign_text::line_at(text, error.span().map_or(0, |span| span.start));
        StudyError::Malformed { file: file.to_owned(), line, cause: with_suggestion(error.message()) }
    })?;
    let check = Checker { file };
    check.counts(&read)?;
    let experiments = read.experiment.iter().enumerate();
    let experiments: Vec<Experiment> = experiments
        .map(|(index, experiment)| check.experiment(index, experiment, &read.set))
        .collect::<Result<_, _>>()?;
    check.names(&experiments)?;
    let targets = read.parameter.iter().enumerate();
    let targets = targets
        .map(|(index, parameter)| check.parameter(index, parameter, &experiments))
        .collect::<Result<Vec<Target>, _>>()?;
    let mut seen = BTreeSet::new();
    if let Some(twice) = read.parameter.iter().find(|parameter| !seen.insert(&parameter.key)) {
        return Err(check.conflict(twice.key.clone(), "is a duplicate key"));
    }
    let huber = match (read.loss, read.huber_sd) {
        (Loss::Squares, Some(_)) => {
            return Err(check.conflict("huber_sd".to_owned(), "is only for `loss = \"huber\"`"));
        }
        (Loss::Squares, None) => None,
        (Loss::Huber, at) => Some(check.finite("huber_sd", at.unwrap_or(STANDARD_HUBER_SD), 0.1, 100.0)?),
    };
    let method = Method {
        starts: read.starts.unwrap_or(1),
        seed: read.seed,
        iterations: read.iterations.unwrap_or(STANDARD_ITERATIONS),
        huber,
    };
    let draws = read.draws.unwrap_or(STANDARD_DRAWS);
    Ok(Study { parameters: read.parameter, targets, experiments, method, draws })
}

/// Adds the nearest known key to an error about an unknown one.
fn with_suggestion(message: &str) -> String {
    let mut quoted = message.split('`').skip(1).step_by(2);
    let (Some(unknown), true) = (quoted.next(), message.starts_with("unknown ")) else {
        return message.to_owned();
    };
    let near = nearest_name(unknown, quoted);
    near.map_or(message.to_owned(), |near| format!("{message} (did you mean `{near}`?)"))
}

/// Returns whether a name may be part of a parameter's key and of a file name.
fn is_name(name: &str) -> bool {
    let is_part = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
    !name.is_empty() && name.len() <= 64 && name.chars().all(is_part)
}

const NAME_EXPECTED: &str = "1 to 64 letters, digits, `_` or `-`";

impl Checker<'_> {
    fn counts(&self, read: &Text) -> Result<(), StudyError> {
        let bad = |key: &str, given: usize, low: usize, high: usize| match (low..=high).contains(&given) {
            true => Ok(()),
            false => Err(self.value(key.to_owned(), given, format!("{low} to {high}"))),
        };
        bad("parameter", read.parameter.len(), 1, MAX_PARAMETERS)?;
        bad("experiment", read.experiment.len(), 1, MAX_EXPERIMENTS)?;
        bad("starts", read.starts.unwrap_or(1) as usize, 1, MAX_STARTS as usize)?;
        bad("iterations", read.iterations.unwrap_or(1) as usize, 1, 10_000)?;
        bad("draws", read.draws.unwrap_or(2), 2, MAX_DRAWS)
    }

    fn names(&self, experiments: &[Experiment]) -> Result<(), StudyError> {
        let mut seen = BTreeSet::new();
        for experiment in experiments {
            if !seen.insert(&experiment.name) {
                let problem = format!("duplicate name `{}`", experiment.name);
                return Err(self.conflict("experiment.name".to_owned(), problem));
            }
        }
        // One name is one sensor, so its unit and number of columns are the same everywhere.
        let all = experiments.iter().flat_map(|experiment| &experiment.measured);
        let mut known: Vec<&Measured> = Vec::new();
        for measured in all {
            match known.iter().find(|other| other.name == measured.name) {
                Some(other)
                    if other.unit_name != measured.unit_name
                        || other.columns.len() != measured.columns.len() =>
                {
                    return Err(self.conflict(
                        format!("measured.{}", measured.name),
                        "differs in `unit` or in the number of `columns` between experiments; one name is one \
                         sensor",
                    ));
                }
                Some(_) => {}
                None => known.push(measured),
            }
        }
        let is_used = |experiment: &Experiment| matches!(experiment.role, Role::Fitted | Role::Candidate);
        if !experiments.iter().any(is_used) {
            let problem = "is missing: every experiment is held out or predicted";
            return Err(self.conflict("experiment.measured".to_owned(), problem));
        }
        Ok(())
    }

    fn parameter(
        &self,
        index: usize,
        parameter: &Parameter,
        experiments: &[Experiment],
    ) -> Result<Target, StudyError> {
        let key = |name: &str| format!("parameter.{index}.{name}");
        let Parameter { min, max, .. } = *parameter;
        let part = |part: &str| {
            !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || "_-[]".contains(c))
        };
        if parameter.key.len() > 200 || !parameter.key.split('.').all(part) {
            let given = format!("`{}`", parameter.key);
            return Err(self.value(key("key"), given, super::target::EXPECTED));
        }
        if !min.is_finite() || !max.is_finite() || min >= max {
            return Err(self.value(key("max"), max, format!("a finite number above `min`, which is {min}")));
        }
        if parameter.scale == Scale::Log && min <= 0.0 {
            return Err(self.value(key("min"), min, "a number above 0, because `scale` is \"log\""));
        }
        if let Some(start) = parameter.start {
            self.finite(&key("start"), start, min, max)?;
        }
        if let Some(step) = parameter.step {
            self.finite(&key("step"), step, 1e-7, 0.25)?;
        }
        if let Some(prior) = parameter.prior {
            if !(prior.sd > 0.0 && prior.sd.is_finite()) {
                return Err(self.value(key("prior.sd"), prior.sd, "a number above 0"));
            }
            if !prior.mean.is_finite() {
                return Err(self.value(key("prior.mean"), prior.mean, "a finite number"));
            }
        }
        let names: Vec<&str> = experiments.iter().map(|experiment| experiment.name.as_str()).collect();
        let measured = || experiments.iter().flat_map(|experiment| &experiment.measured);
        let tables = || {
            experiments.iter().filter_map(|experiment| match &experiment.commands {
                Commands::Table(table) => Some(table),
                _ => None,
            })
        };
        let has_measured = |name: &str| measured().any(|measured| measured.name == name);
        let has_command = |name: &str| tables().flat_map(|table| &table.columns).any(|it| it.name == name);
        let target = Target::parse(&parameter.key, &names, has_measured, has_command)
            .map_err(|problem| self.conflict(key("key"), format!("`{}` {problem}", parameter.key)))?;
        if let Target::Measured { name, part: SignalPart::Bias(Some(index)) } = &target
            && measured().any(|it| it.name == *name && *index >= it.columns.len())
        {
            return Err(self.conflict(key("key"), format!("`{}` has no such column", parameter.key)));
        }
        Ok(target)
    }

    fn experiment(
        &self,
        index: usize,
        text: &ExperimentText,
        set: &[String],
    ) -> Result<Experiment, StudyError> {
        let key = |name: &str| format!("experiment.{index}.{name}");
        if !is_name(&text.name) {
            return Err(self.value(key("name"), format!("`{}`", text.name), NAME_EXPECTED));
        }
        if text.held_out && text.candidate {
            return Err(
                self.conflict(key("held_out"), "and `candidate` are mutually exclusive; set only one")
            );
        }
        if text.measured.is_empty() || text.measured.len() > MAX_MEASURED {
            return Err(self.value(key("measured"), text.measured.len(), format!("1 to {MAX_MEASURED}")));
        }
        if let Some(duration_s) = text.duration_s {
            self.finite(&key("duration_s"), duration_s, 0.001, scene_seconds())?;
        }
        if !text.clock_offset_s.is_finite() {
            return Err(self.value(key("clock_offset_s"), text.clock_offset_s, "a finite number"));
        }
        let commands = match &text.commands {
            None => Commands::Scene,
            Some(commands) => self.commands(&key("commands"), commands, text)?,
        };
        if text.scene.is_none() && !matches!(commands, Commands::Log(_)) {
            return Err(self.conflict(key("scene"), "is missing; only a log of commands brings its own"));
        }
        let measured = text.measured.iter().enumerate();
        let measured: Vec<Measured> = measured
            .map(|(i, measured)| self.measured(&format!("{}.{i}", key("measured")), measured, text))
            .collect::<Result<_, _>>()?;
        let mut seen = BTreeSet::new();
        if let Some(twice) = measured.iter().find(|measured| !seen.insert(&measured.name)) {
            return Err(self.conflict(key("measured"), format!("duplicate name `{}`", twice.name)));
        }
        let with_file = measured.iter().filter(|measured| measured.source.is_some()).count();
        let role = match () {
            () if text.candidate => Role::Candidate,
            () if with_file == 0 => Role::Predicted,
            () if with_file < measured.len() => {
                return Err(self.conflict(
                    key("file"),
                    "is missing for some measured quantities; give all of them a file, or none to predict",
                ));
            }
            () if text.held_out => Role::HeldOut,
            () => Role::Fitted,
        };
        let is_planned = matches!(role, Role::Candidate | Role::Predicted);
        if let Some(bare) = measured.iter().find(|it| is_planned && it.rate_hz.is_none()) {
            return Err(self.conflict(
                key("measured"),
                format!("`{}` needs `rate_hz`, because the experiment has no file", bare.name),
            ));
        }
        Ok(Experiment {
            name: text.name.clone(),
            scene: text.scene.clone(),
            set: [set, &text.set].concat(),
            duration_s: text.duration_s,
            role,
            commands,
            clock_offset_s: text.clock_offset_s,
            clock_zero: text.clock_zero,
            measured,
        })
    }

    fn source(
        &self,
        key: &str,
        file: Option<&PathBuf>,
        topic: Option<&String>,
        time: Option<&String>,
        time_unit: Option<&String>,
    ) -> Result<Option<Source>, StudyError> {
        let Some(file) = file else { return Ok(None) };
        let time_unit = time_unit.map_or("s", String::as_str);
        Dimension::Time
            .size_of(time_unit)
            .map_err(|expected| self.value(format!("{key}.time_unit"), format!("`{time_unit}`"), expected))?;
        let ending = file.extension().map(|ending| ending.to_string_lossy().to_lowercase());
        let is_table = matches!(ending.as_deref(), Some("csv" | "tsv" | "txt" | "parquet"));
        match (is_table, time, topic) {
            (true, None, _) => {
                Err(self.conflict(format!("{key}.time"), "is missing: the column with the time"))
            }
            (true, _, Some(_)) => {
                Err(self.conflict(format!("{key}.topic"), "is only for MCAP files and rosbag2 folders"))
            }
            (false, _, None) => Err(self.conflict(
                format!("{key}.topic"),
                "is missing; a file that ends in neither .csv, .tsv, .txt nor .parquet is read as MCAP",
            )),
            _ => Ok(Some(Source {
                file: file.clone(),
                topic: topic.cloned(),
                time: time.cloned(),
                time_unit: time_unit.to_owned(),
            })),
        }
    }

    fn measured(
        &self,
        key: &str,
        text: &MeasuredText,
        experiment: &ExperimentText,
    ) -> Result<Measured, StudyError> {
        let at = |name: &str| format!("{key}.{name}");
        if !is_name(&text.name) {
            return Err(self.value(at("name"), format!("`{}`", text.name), NAME_EXPECTED));
        }
        let count = text.columns.len();
        text.of
            .check_count(count)
            .map_err(|expected| self.value(at("columns"), format!("{count} columns"), expected))?;
        let unit = text.of.dimension(text.field.as_deref()).size_of(&text.unit);
        let unit = unit.map_err(|expected| self.value(at("unit"), format!("`{}`", text.unit), expected))?;
        let quantity = self.quantity(key, text)?;
        let shape = match text.of {
            Kind::Position => Shape::Point,
            Kind::FlangeForce | Kind::FlangeTorque => Shape::Vector,
            _ => Shape::Scalars,
        };
        if shape != Shape::Point && text.frame_mm.is_some() {
            return Err(self.conflict(at("frame_mm"), "is only for positions"));
        }
        if shape == Shape::Scalars && text.frame_deg.is_some() {
            return Err(self.conflict(at("frame_deg"), "is only for positions, forces and torques"));
        }
        let expected = || format!("a number, or {count} numbers, one for each column");
        let noise = text.noise.as_ref().map(|noise| {
            let each = noise.each(count).filter(|each| each.iter().all(|sd| *sd > 0.0 && sd.is_finite()));
            each.ok_or_else(|| self.value(at("noise"), "malformed", format!("{} above 0", expected())))
        });
        let bias = text.bias.as_ref().map(|bias| {
            let each = bias.each(count).filter(|each| each.iter().all(|value| value.is_finite()));
            each.ok_or_else(|| self.value(at("bias"), "malformed", expected()))
        });
        let rate_hz = text.rate_hz.map(|rate| self.finite(&at("rate_hz"), rate, 0.01, 1e5)).transpose()?;
        let is_planned = experiment.candidate;
        let file = text.file.as_ref().or(experiment.file.as_ref()).filter(|_| !is_planned);
        let source = self.source(
            key,
            file,
            text.topic.as_ref(),
            text.time.as_ref().or(experiment.time.as_ref()),
            text.time_unit.as_ref().or(experiment.time_unit.as_ref()),
        )?;
        let signal = Signal {
            delay_s: self.finite(&at("delay_ms"), text.delay_ms.unwrap_or(0.0), -1e6, 1e6)? * 1e-3,
            gain: self.finite(&at("gain"), text.gain.unwrap_or(1.0), -1e9, 1e9)?,
            bias: bias.transpose()?.unwrap_or_else(|| vec![0.0; count]),
            frame_m: text.frame_mm.unwrap_or_default().map(|x| x * 1e-3),
            frame_rad: text.frame_deg.unwrap_or_default().map(f64::to_radians),
        };
        if signal.frame_m.iter().chain(&signal.frame_rad).any(|x| !x.is_finite()) {
            return Err(self.value(at("frame_mm"), "not finite", "finite numbers"));
        }
        Ok(Measured {
            name: text.name.clone(),
            quantity,
            shape,
            columns: text.columns.clone(),
            unit_name: text.unit.clone(),
            unit,
            noise: noise.transpose()?,
            source,
            signal,
            rate_hz,
        })
    }

    fn quantity(&self, key: &str, text: &MeasuredText) -> Result<Quantity, StudyError> {
        let at = |name: &str| format!("{key}.{name}");
        let has_body = matches!(text.of, Kind::Position | Kind::Pixel);
        let only = |name: &str, is_given: bool, fits: bool, of: &str| match is_given && !fits {
            true => Err(self.conflict(at(name), format!("is only for {of}"))),
            false => Ok(()),
        };
        only("body", text.body.is_some(), has_body, "`position` and `pixel`")?;
        only("point_mm", text.point_mm.is_some(), has_body, "`position` and `pixel`")?;
        only("frame", text.frame.is_some(), text.of.has_frame(), "positions, forces and torques")?;
        only("gauge_mm", text.gauge_mm.is_some(), text.of == Kind::Curvature, "`curvature`")?;
        only("field", text.field.is_some(), text.of == Kind::Field, "`field`")?;
        only("link", text.link.is_some(), text.body == Some(Body::Link), "`body = \"link\"`")?;
        if text.body == Some(Body::Link) && text.link.is_none_or(|link| link >= MAX_JOINTS) {
            let given = text.link.map_or("missing".to_owned(), |link| link.to_string());
            return Err(self.value(at("link"), given, format!("0 to {}", MAX_JOINTS - 1)));
        }
        let field = match (text.of, &text.field) {
            (Kind::Field, None) => return Err(self.conflict(at("field"), "is missing")),
            (_, Some(path)) => Some(Quantity::scalar(path).map_err(|why| self.conflict(at("field"), why))?),
            (_, None) => None,
        };
        let usual = if text.of == Kind::Position { Frame::Patient } else { Frame::Base };
        let gauge_mm = text.gauge_mm.unwrap_or(5.0);
        Ok(Quantity {
            kind: text.of,
            body: text.body.unwrap_or_default(),
            link: text.link.unwrap_or(0),
            point_m: text.point_mm.unwrap_or_default().map(|x| x * 1e-3),
            frame: text.frame.unwrap_or(usual),
            gauge_m: self.finite(&at("gauge_mm"), gauge_mm, 0.1, 100.0)? * 1e-3,
            field,
        })
    }

    fn commands(
        &self,
        key: &str,
        text: &CommandsText,
        experiment: &ExperimentText,
    ) -> Result<Commands, StudyError> {
        let at = |name: &str| format!("{key}.{name}");
        if let Some(log) = &text.log {
            let is_alone = text.file.is_none() && text.column.is_empty() && text.controller.is_none();
            return match is_alone {
                true => Ok(Commands::Log(log.clone())),
                false => {
                    Err(self.conflict(at("log"), "and `file`, `column`, `controller` are mutually exclusive"))
                }
            };
        }
        if text.column.is_empty() {
            return Err(self.conflict(at("column"), "is missing; set `log` or at least one `column`"));
        }
        let source = self.source(
            key,
            text.file.as_ref().or(experiment.file.as_ref()),
            text.topic.as_ref(),
            text.time.as_ref().or(experiment.time.as_ref()),
            text.time_unit.as_ref().or(experiment.time_unit.as_ref()),
        )?;
        let source = source.ok_or_else(|| self.conflict(at("file"), "is missing"))?;
        let mut columns = Vec::new();
        for (i, column) in text.column.iter().enumerate() {
            let at = |name: &str| format!("{key}.column.{i}.{name}");
            let found = run_log::columns::columns(Command::DESCRIPTION, std::slice::from_ref(&column.field));
            let found = found.map_err(|cause| self.conflict(at("field"), cause))?;
            let is_scalar = matches!(found.as_slice(), [one] if one.ros_type == "float64");
            if !is_scalar {
                let expected = "one number of a command, such as `tendon_force_n[0]`";
                return Err(self.value(at("field"), format!("`{}`", column.field), expected));
            }
            let from = match (&column.column, column.value) {
                (Some(name), None) => ColumnOrValue::Column(name.clone()),
                (None, Some(value)) if value.is_finite() => ColumnOrValue::Value(value),
                _ => return Err(self.conflict(at("column"), "or a finite `value` is required, not both")),
            };
            let dimension = Dimension::of_field(&column.field);
            let unit = column.unit.as_deref().unwrap_or(dimension.units()[0]);
            let size = dimension.size_of(unit);
            let name = column.name.clone().unwrap_or_else(|| column.field.clone());
            if column.name.as_deref().is_some_and(|name| !is_name(name)) {
                return Err(self.value(at("name"), format!("`{name}`"), NAME_EXPECTED));
            }
            columns.push(CommandColumn {
                name,
                field: column.field.clone(),
                from,
                unit: size.map_err(|expected| self.value(at("unit"), format!("`{unit}`"), expected))?,
                gain: self.finite(&at("gain"), column.gain.unwrap_or(1.0), -1e9, 1e9)?,
                bias: self.finite(&at("bias"), column.bias.unwrap_or(0.0), -1e9, 1e9)?,
                delay_s: self.finite(&at("delay_ms"), column.delay_ms.unwrap_or(0.0), -1e6, 1e6)? * 1e-3,
            });
        }
        Ok(Commands::Table(CommandTable {
            controller: text.controller.clone(),
            source,
            clock_offset_s: text.clock_offset_s.unwrap_or(experiment.clock_offset_s),
            modes: self.modes(key, text, &columns)?,
            columns,
        }))
    }

    /// Returns the modes of a command: those that the study names, or those that its fields imply.
    fn modes(
        &self,
        key: &str,
        text: &CommandsText,
        columns: &[CommandColumn],
    ) -> Result<[u32; 4], StudyError> {
        let has = |start: &str| columns.iter().any(|column| column.field.starts_with(start));
        let tendon = match text.tendon_mode.as_deref() {
            Some("servo_jf") => TendonMode::ServoJf.code(),
            Some("servo_jp") => TendonMode::ServoJp.code(),
            Some("move_jp") => TendonMode::MoveJp.code(),
            Some("servo_jv") => TendonMode::ServoJv.code(),
            Some(other) => {
                let expected = "\"servo_jf\", \"servo_jp\", \"move_jp\" or \"servo_jv\"";
                return Err(self.value(format!("{key}.tendon_mode"), format!("`{other}`"), expected));
            }
            None if has("tendon_force_n") => TendonMode::ServoJf.code(),
            None if has("tendon_displacement_m") => TendonMode::ServoJp.code(),
            None if has("tendon_velocity_m_per_s") => TendonMode::ServoJv.code(),
            None => 0,
        };
        const ARM: [(&str, ArmMode); 7] = [
            ("servo_jp", ArmMode::ServoJp),
            ("move_jp", ArmMode::MoveJp),
            ("servo_cp", ArmMode::ServoCp),
            ("move_cp", ArmMode::MoveCp),
            ("hold", ArmMode::Hold),
            ("servo_jv", ArmMode::ServoJv),
            ("insert", ArmMode::Insert),
        ];
        let arm = match text.arm_mode.as_deref() {
            Some(given) => match ARM.iter().find(|(name, _)| *name == given) {
                Some((_, mode)) => mode.code(),
                None => {
                    let names = ARM.map(|(name, _)| name).join("`, `");
                    let expected = format!("one of `{names}`");
                    return Err(self.value(format!("{key}.arm_mode"), format!("`{given}`"), expected));
                }
            },
            None if has("arm_joint_position_rad") => ArmMode::ServoJp.code(),
            None if has("arm_joint_velocity_rad_per_s") => ArmMode::ServoJv.code(),
            None if has("t_world_base") => ArmMode::ServoCp.code(),
            None if has("arm_depth_m") => ArmMode::Insert.code(),
            None => 0,
        };
        let burr = if has("burr_speed_rad_per_s") { BurrMode::Speed.code() } else { 0 };
        let is_tube = has("tube_deployed_m") || has("tube_roll_rad");
        let tube = if is_tube { TubeMode::MoveJp.code() } else { 0 };
        Ok([tendon, arm, burr, tube])
    }
}

/// Longest experiment, s: an hour.
fn scene_seconds() -> f64 {
    3600.0
}
