//! Parses the requests of a peer.

use ipc_types::messages::{MAX_POSITION_M, Pose};
use openigtlink::{Body, Message, Point};

use crate::ras;

/// Device names of the messages that a peer can send, and their meanings. A test compares `docs/slicer.md`
/// with it.
pub const UNDERSTOOD: [(&str, &str, &str); 5] = [
    ("STRING", "Token", "the control token; once per connection"),
    ("STRING", "Command", "`pause`, `resume`, `stop`, or `halt` (abandons the current plan)"),
    (
        "TRANSFORM",
        "CArmToRAS",
        "takes an X-ray, sent as `XRayOnRequest`, with the C-arm at this pose (origin: isocentre; +z: \
         toward the source)",
    ),
    ("TRANSFORM", "BaseGoalToRAS", "the arm moves the tool's base there"),
    (
        "POINT",
        "Plan",
        "points named `Entry` and `Target`: the arm moves the tip to the entry and feeds straight to the \
         target; `Target` alone: straight from the tip's current position",
    ),
];

/// A request of a peer.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Request {
    /// A token that proves the right to control.
    Token(String),
    /// Stop at the next tick.
    Pause,
    /// Continue.
    Resume,
    /// End the run.
    Stop,
    /// Abandon the current plan and hold the arm.
    Halt,
    /// Render a frame with the C-arm at this pose.
    Frame(Pose),
    /// Move the tool base to this goal.
    BaseGoal(Pose),
    /// Feed the tip to the target, from the entry if there is one.
    Plan {
        /// Where the tip enters.
        entry_m: Option<[f64; 3]>,
        /// Where the tip ends.
        target_m: [f64; 3],
    },
}

/// Parses a message; returns `Ok(None)` if it is addressed to another program.
///
/// # Errors
/// A sentence that describes what is wrong with the message.
pub(crate) fn request(message: &Message) -> Result<Option<Request>, String> {
    match (&message.body, message.device.as_str()) {
        (Body::Text(text), "Token") => Ok(Some(Request::Token(text.clone()))),
        (Body::Text(text), "Command") => command(text).map(Some),
        (Body::Transform(transform), device @ ("CArmToRAS" | "BaseGoalToRAS")) => {
            let pose = ras::pose(transform);
            let pose = pose.ok_or_else(|| format!("{device}: the matrix is not a rotation within 1e-3"))?;
            in_reach(device, transform.translation_mm)?;
            Ok(Some(if device == "CArmToRAS" { Request::Frame(pose) } else { Request::BaseGoal(pose) }))
        }
        (Body::Points(points), "Plan") => plan(points).map(Some),
        _ => Ok(None),
    }
}

/// Checks a position's range, which is that of commands: no goal beyond it can be reached or even sent.
pub(crate) fn in_reach(what: &str, position_mm: [f32; 3]) -> Result<(), String> {
    let most_mm = 1000.0 * MAX_POSITION_M;
    match position_mm.into_iter().find(|value| f64::from(value.abs()) > most_mm) {
        None => Ok(()),
        Some(value) => {
            Err(format!("{what}: a coordinate is {value:e} mm; allowed: {} to {most_mm} mm", -most_mm))
        }
    }
}

fn command(text: &str) -> Result<Request, String> {
    match text.trim() {
        "pause" => Ok(Request::Pause),
        "resume" => Ok(Request::Resume),
        "stop" => Ok(Request::Stop),
        "halt" => Ok(Request::Halt),
        other => {
            let other = foreign_text::foreign(other);
            Err(format!("Command: unknown command {other}; expected pause, resume, stop or halt"))
        }
    }
}

fn plan(points: &[Point]) -> Result<Request, String> {
    let mut found = [None, None];
    for (place, name) in found.iter_mut().zip(["Entry", "Target"]) {
        let mut named = points.iter().filter(|point| point.name == name);
        let Some(point) = named.next() else { continue };
        if named.next().is_some() {
            return Err(format!("Plan: duplicate point {name}"));
        }
        in_reach(&format!("Plan: {name}"), point.position_mm)?;
        *place = Some(ras::position_m(point.position_mm));
    }
    let [entry_m, target_m] = found;
    let target_m = target_m.ok_or("Plan: missing point Target")?;
    Ok(Request::Plan { entry_m, target_m })
}

#[cfg(test)]
mod tests {
    use openigtlink::Transform;

    use super::*;

    fn point(name: &str, position_mm: [f32; 3]) -> Point {
        let (group, owner) = (String::new(), String::new());
        Point { name: name.into(), group, rgba: [0; 4], position_mm, diameter_mm: 0.0, owner }
    }

    #[test]
    fn slicers_points_become_ours() {
        let points = vec![point("Target", [10.0, 20.0, 30.0]), point("Other", [0.0; 3])];
        let message = Message::new("Plan", Body::Points(points)).unwrap();
        let wanted = Request::Plan { entry_m: None, target_m: [-0.01, -0.02, 0.03] };
        assert_eq!(request(&message), Ok(Some(wanted)));
    }

    #[test]
    fn what_is_wrong_is_said_and_what_is_not_for_us_is_left() {
        let ask = |device: &str, body: Body| request(&Message::new(device, body).unwrap());
        assert_eq!(
            ask("Command", Body::Text("jump".into())).unwrap_err(),
            "Command: unknown command jump; expected pause, resume, stop or halt"
        );
        assert_eq!(ask("Plan", Body::Points(vec![])).unwrap_err(), "Plan: missing point Target");
        let twice = vec![point("Target", [0.0; 3]), point("Target", [1.0; 3])];
        assert_eq!(ask("Plan", Body::Points(twice)).unwrap_err(), "Plan: duplicate point Target");
        let mirrored = Transform {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
            translation_mm: [0.0; 3],
        };
        assert!(ask("CArmToRAS", Body::Transform(mirrored)).is_err());
        let far = Transform {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation_mm: [0.0, 10_001.0, 0.0],
        };
        for device in ["CArmToRAS", "BaseGoalToRAS"] {
            assert!(
                ask(device, Body::Transform(far)).unwrap_err().contains("-10000 to 10000 mm"),
                "{device}"
            );
        }
        let far = vec![point("Target", [0.0; 3]), point("Entry", [0.0, 0.0, -1e30])];
        assert!(
            ask("Plan", Body::Points(far)).unwrap_err().starts_with("Plan: Entry: a coordinate is -1e30")
        );
        assert_eq!(ask("ProbeToTracker", Body::Transform(mirrored)), Ok(None));
    }
}
