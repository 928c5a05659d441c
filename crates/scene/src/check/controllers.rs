//! Checks the controllers of a scene: what each drives, and how the keys of each kind relate.

use foreign_text::nearest_name;
use messages::BodyMode;

use super::Checker;
use crate::error::SceneError;
use crate::model::{
    Body, BodyMotion, Controller, CurvedDrilling, Display, Drives, Drr, Feedback, Scene, TensionSweep,
    whole_steps,
};

/// Names of the other processes, and end reasons that are not process names: a log's end names its cause.
const RESERVED_NAMES: [&str; 7] =
    ["physics", "drr", "recorder", "launcher", "completed", "stopped", "interrupted"];

pub(super) fn check(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    let mut driven: Vec<(Drives, Option<&str>, &str)> = Vec::new();
    for (index, controller) in scene.controller.iter().enumerate() {
        if RESERVED_NAMES.contains(&controller.name.as_str()) {
            let problem =
                format!("`{}` is a reserved name; reserved are {RESERVED_NAMES:?}", controller.name);
            return Err(checker.invalid("controller.name", problem));
        }
        let earlier = scene.controller[..index].iter().map(|it| &it.name);
        checker.distinct("controller.name", &controller.name, earlier)?;
        for part in &controller.drives {
            // Every body is a part of its own.
            let body = controller.body.as_deref().filter(|_| *part == Drives::Body);
            if let Some((.., other)) = driven.iter().find(|(driven, of, _)| (driven, *of) == (part, body)) {
                let name = body.map_or(format!("`{}`", part.name()), |body| format!("body `{body}`"));
                let problem = format!(
                    "{name} is driven by both `{other}` and `{}`; only one may drive it",
                    controller.name
                );
                return Err(checker.invalid("controller.drives", problem));
            }
            driven.push((*part, body, &controller.name));
        }
        check_controller(controller, checker)?;
        check_fmu(controller, scene, checker)?;
        check_image_feedback(controller, scene.drr.as_ref(), checker)?;
        check_tube(controller, scene, checker)?;
        check_body(controller, scene, checker)?;
    }
    let is_undriven = |body: &&Body| {
        body.motion == BodyMotion::Driven && !driven.iter().any(|(_, of, _)| *of == Some(&body.name))
    };
    // After the controllers: a misspelled `controller.body` is the cause.
    match scene.body.iter().find(is_undriven) {
        Some(Body { name, .. }) => {
            let problem = format!(
                "of `{name}` is \"driven\", but no `controller.body` names it; use \"fixed\" for a body that \
                 stays"
            );
            Err(checker.invalid("body.motion", problem))
        }
        None => Ok(()),
    }
}

/// Checks that image feedback has frames in which metal is dark: it finds the burr as the darkest end of the
/// tool.
fn check_image_feedback(
    controller: &Controller,
    drr: Option<&Drr>,
    checker: &Checker,
) -> Result<(), SceneError> {
    let Some(drilling) = &controller.curved_drilling else { return Ok(()) };
    let problem = match drr {
        _ if drilling.feedback != Feedback::Image => return Ok(()),
        None if drilling.guidance_gain_n_per_mm > 0.0 => {
            "is `image` with a gain, but there is no `[drr]`; add `[drr]`, or use `shape` or `none`"
        }
        Some(drr) if drr.display != Display::BoneDark => {
            "is `image`, which looks for the burr as the darkest spot; set `drr.display = \"bone_dark\"`, \
             or use `shape` or `none`"
        }
        _ => return Ok(()),
    };
    Err(checker.invalid("controller.curved_drilling.feedback", problem))
}

/// Checks that a driven tube exists, and that the deployment stays within its travel and speed.
fn check_tube(controller: &Controller, scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    let outer = scene.manipulator.outer_tube();
    match (outer, &controller.tube_deployment) {
        (None, Some(_)) => {
            let problem = "needs a tool with `outer_tube`; the scene's tool has none";
            Err(checker.invalid("controller.tube_deployment", problem))
        }
        (None, None) if controller.drives.contains(&Drives::Tube) => {
            let problem = "lists `tube`, which needs a tool with `outer_tube`; the scene's tool has none";
            Err(checker.invalid("controller.drives", problem))
        }
        (Some(outer), Some(plan)) => {
            let key = |name: &str| format!("controller.tube_deployment.{name}");
            checker.at_most(&key("deployed_mm"), plan.deployed_mm, outer.travel_mm)?;
            checker.at_most(&key("feed_mm_per_s"), plan.feed_mm_per_s, outer.speed_mm_per_s)?;
            checker.at_most(&key("retraction_mm"), plan.retraction_mm, plan.deployed_mm)
        }
        _ => Ok(()),
    }
}

/// Checks that a driven body exists and can move, and that an FMU with a constant mode drives it in a way
/// that its motion allows.
fn check_body(controller: &Controller, scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    let invalid = |problem: String| Err(checker.invalid("controller.body", problem));
    let drives_one = controller.drives.contains(&Drives::Body);
    let name = match &controller.body {
        None if drives_one => {
            return invalid("is missing, but `drives` lists `body`; name a `[[body]]`".into());
        }
        None => return Ok(()),
        Some(_) if !drives_one => {
            return invalid("applies only to a controller whose `drives` lists `body`".into());
        }
        Some(name) => name,
    };
    if !controller.external && !controller.is_program() {
        return invalid(
            "needs a controller with `external`, `command` or `fmu`: none that is built in drives a body"
                .into(),
        );
    }
    let Some(body) = scene.body.iter().find(|body| body.name == *name) else {
        let names: Vec<&str> = scene.body.iter().map(|body| body.name.as_str()).collect();
        let near = nearest_name(name, names.iter().copied());
        let meant = near.map_or(String::new(), |near| format!(" (did you mean `{near}`?)"));
        return invalid(format!("is `{name}`{meant}; expected the name of a `[[body]]`: {names:?}"));
    };
    let mode = controller.constants.get("body_mode").copied();
    let is_mode = |of: BodyMode| mode == Some(f64::from(of.code()));
    match body.motion {
        BodyMotion::Fixed => invalid(format!(
            "is `{name}`, whose `motion` is \"fixed\"; expected \"free\" for servo_cf or \"driven\" for servo_cp"
        )),
        BodyMotion::Free if is_mode(BodyMode::ServoCp) => invalid(format!(
            "is `{name}`, whose `motion` is \"free\"; servo_cp (`body_mode = 2`) needs \"driven\""
        )),
        BodyMotion::Driven if is_mode(BodyMode::ServoCf) => invalid(format!(
            "is `{name}`, whose `motion` is \"driven\"; servo_cf (`body_mode = 1`) needs \"free\""
        )),
        BodyMotion::Free | BodyMotion::Driven => Ok(()),
    }
}

fn check_controller(controller: &Controller, checker: &Checker) -> Result<(), SceneError> {
    let kinds = [
        controller.curved_drilling.is_some(),
        controller.skiving.is_some(),
        controller.tension_sweep.is_some(),
        controller.tube_deployment.is_some(),
        controller.hold.is_some(),
        controller.fmu.is_some(),
        controller.command.is_some(),
        controller.external,
    ];
    if kinds.iter().filter(|kind| **kind).count() != 1 {
        let problem = format!(
            "`{}` needs exactly one of `curved_drilling`, `skiving`, `tension_sweep`, `tube_deployment`, \
             `hold`, `fmu`, `command`, `external`",
            controller.name
        );
        return Err(checker.invalid("controller", problem));
    }
    if controller.optional && !controller.external && !controller.is_program() {
        let problem = "applies only to a controller with `external`, `command` or `fmu`";
        return Err(checker.invalid("controller.optional", problem));
    }
    if controller.restarts > 0 && !controller.is_program() {
        let problem = "applies only to a controller with `command` or `fmu`";
        return Err(checker.invalid("controller.restarts", problem));
    }
    if let Some(drilling) = &controller.curved_drilling {
        check_curved_drilling(drilling, checker)?;
    }
    if let Some(sweep) = &controller.tension_sweep {
        check_sweep(sweep, checker)?;
    }
    if controller.command.as_ref().is_some_and(Vec::is_empty) {
        return Err(checker.invalid("controller.command", "is empty; expected a program and its arguments"));
    }
    Ok(())
}

/// Checks the keys of an FMU; its variables are checked with its model description.
fn check_fmu(controller: &Controller, scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    let used = [
        ("inputs", !controller.inputs.is_empty()),
        ("outputs", !controller.outputs.is_empty()),
        ("constants", !controller.constants.is_empty()),
        ("parameters", !controller.parameters.is_empty()),
        ("step_ms", controller.step_ms.is_some()),
        ("preload", controller.preload.is_some()),
    ];
    let key = |name: &str| format!("controller.{name}");
    if let Some((name, _)) = used.iter().find(|(_, is_used)| *is_used && controller.fmu.is_none()) {
        return Err(checker.invalid(&key(name), "applies only to a controller with `fmu`"));
    }
    for (table, values) in [("constants", &controller.constants), ("parameters", &controller.parameters)] {
        if let Some((name, value)) = values.iter().find(|(_, value)| !value.is_finite()) {
            return Err(
                checker.invalid(&key(table), format!("sets `{name}` to {value}; expected a finite number"))
            );
        }
    }
    if let Some(name) = controller.outputs.keys().find(|name| controller.constants.contains_key(*name)) {
        return Err(
            checker.invalid(&key("outputs"), format!("and `constants` both set `{name}`; set it once"))
        );
    }
    let dt_ms = scene.run.dt_ms;
    match controller.step_ms {
        Some(step_ms) if whole_steps(step_ms, dt_ms).is_none() => {
            let problem = format!("is {step_ms}; expected a multiple of `run.dt_ms`, {dt_ms}");
            Err(checker.invalid(&key("step_ms"), problem))
        }
        _ => Ok(()),
    }
}

fn check_sweep(sweep: &TensionSweep, checker: &Checker) -> Result<(), SceneError> {
    match (sweep.most_n.zip(sweep.step_n), sweep.most_mm.zip(sweep.step_mm)) {
        (Some((most_n, step_n)), None) if sweep.most_mm.is_none() && sweep.step_mm.is_none() => {
            checker.at_most("controller.tension_sweep.step_n", step_n, most_n)
        }
        (None, Some((most_mm, step_mm))) if sweep.most_n.is_none() && sweep.step_n.is_none() => {
            checker.at_most("controller.tension_sweep.step_mm", step_mm, most_mm)
        }
        _ => {
            let has_force = sweep.most_n.or(sweep.step_n).is_some();
            let problem = match has_force && sweep.most_mm.or(sweep.step_mm).is_some() {
                true => {
                    "has keys of both `most_n`, `step_n` and `most_mm`, `step_mm`, which are mutually \
                     exclusive; set only one pair"
                }
                false => "needs either `most_n` and `step_n`, or `most_mm` and `step_mm`",
            };
            Err(checker.invalid("controller.tension_sweep", problem))
        }
    }
}

fn check_curved_drilling(drilling: &CurvedDrilling, checker: &Checker) -> Result<(), SceneError> {
    let key = |name: &str| format!("controller.curved_drilling.{name}");
    let problem = match (drilling.tension_n, &drilling.calibration) {
        (Some(_), Some(_)) => {
            "has both `tension_n` and `calibration`, which are mutually exclusive; set only one"
        }
        (None, None) => "needs either `tension_n` or `calibration`",
        _ => "",
    };
    if !problem.is_empty() {
        return Err(checker.invalid("controller.curved_drilling", problem));
    }
    if drilling.calibration.is_some() && drilling.target_mm.is_none() {
        return Err(
            checker.invalid(&key("calibration"), "needs `target_mm`, from which the bend is computed")
        );
    }
    checker.at_least(&key("ramp_end_mm"), drilling.ramp_end_mm, drilling.ramp_start_mm)
}
