//! Checks the sensors of a scene and the controllers that use them.

use super::Checker;
use crate::declaration::Range;
use crate::error::SceneError;
use crate::model::{Controller, Feedback, Scene, Sensor};
use crate::{MAX_READINGS_UNDERWAY, Tracker};

pub(super) fn check(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    for (index, sensor) in scene.sensor.iter().enumerate() {
        checker.distinct("sensor.name", &sensor.name, scene.sensor[..index].iter().map(|it| &it.name))?;
        check_kind(sensor, checker)?;
        checker.at_most("sensor.rate_hz", sensor.rate_hz, 1.0 / scene.dt_s())?;
        check_underway(sensor, checker)?;
        if let Some(tracker) = &sensor.tracker {
            check_marker(tracker, checker)?;
        }
    }
    scene.controller.iter().try_for_each(|controller| check_use(controller, scene, checker))
}

fn check_kind(sensor: &Sensor, checker: &Checker) -> Result<(), SceneError> {
    let kinds = [
        sensor.fbg.is_some(),
        sensor.tracker.is_some(),
        sensor.encoders.is_some(),
        sensor.load_cell.is_some(),
        sensor.force_torque.is_some(),
    ];
    if kinds.iter().filter(|kind| **kind).count() != 1 {
        let problem = "needs exactly one of `fbg`, `tracker`, `encoders`, `load_cell`, `force_torque`";
        return Err(checker.invalid(&format!("sensor `{}`", sensor.name), problem));
    }
    Ok(())
}

/// Bounds the readings in transit: those measured but not yet delivered, which the simulation's state holds.
fn check_underway(sensor: &Sensor, checker: &Checker) -> Result<(), SceneError> {
    let longest_ms = MAX_READINGS_UNDERWAY as f64 / sensor.rate_hz * 1e3;
    if sensor.delay_ms + sensor.jitter_ms > longest_ms {
        let problem = format!(
            "and `sensor.jitter_ms` add up to {} ms, so that more than {MAX_READINGS_UNDERWAY} readings of \
             sensor `{}` would be \
             in transit; expected at most {longest_ms:.3} ms at {} Hz",
            sensor.delay_ms + sensor.jitter_ms,
            sensor.name,
            sensor.rate_hz
        );
        return Err(checker.invalid("sensor.delay_ms", problem));
    }
    Ok(())
}

fn check_marker(tracker: &Tracker, checker: &Checker) -> Result<(), SceneError> {
    let length = tracker.marker_faces.iter().map(|x| x * x).sum::<f64>().sqrt();
    checker.range("sensor.tracker.marker_faces", length, Range { lowest: 1e-6, highest: 1e6, or_zero: false })
}

fn check_use(controller: &Controller, scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    if controller.sensors.is_empty() {
        return Ok(());
    }
    let fail = |problem: String| Err(checker.invalid("controller.sensors", problem));
    if controller.external || controller.is_program() {
        return fail("applies only to a built-in controller; other programs read every sensor".to_owned());
    }
    for (index, name) in controller.sensors.iter().enumerate() {
        if !scene.sensor.iter().any(|sensor| sensor.name == *name) {
            let names: Vec<&str> = scene.sensor.iter().map(|sensor| sensor.name.as_str()).collect();
            let known = match names.is_empty() {
                true => "the scene has none".to_owned(),
                false => format!("the scene has {}", names.join(", ")),
            };
            return fail(format!("names `{name}`, which is not a `[[sensor]]`; {known}"));
        }
        if controller.sensors[..index].contains(name) {
            return fail(format!("names `{name}` twice"));
        }
    }
    let image = |plan: &crate::CurvedDrilling| plan.feedback == Feedback::Image;
    if controller.curved_drilling.as_ref().is_some_and(image) {
        return fail(
            "conflicts with `feedback = \"image\"`, which uses only X-ray frames; set `feedback = \"shape\"`"
                .to_owned(),
        );
    }
    Ok(())
}
