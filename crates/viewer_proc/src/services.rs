//! The services: requests that clients can make to the simulator or the time line.

use serde::Deserialize;
use serde_json::{Value, json};

use crate::log::series::SeriesRequest;
use crate::slice::Slice;

/// Service names; their numbers start at 1 in this order.
pub const SERVICES: [&str; 7] = ["/control", "/drive", "/frame", "/playback", "/series", "/slice", "/plan"];
/// Number of `/series`.
const SERIES: u32 = 5;
/// Number of `/slice`.
pub const SLICE: u32 = 6;
/// Number of `/plan`.
const PLAN: u32 = 7;

/// Actions of `/control`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Action {
    /// Pause before the next tick.
    Pause,
    /// Resume.
    Resume,
    /// Run a number of ticks while paused.
    Step,
    /// Reset to the initial state.
    Reset,
    /// End the run.
    Stop,
    /// Limit the run's speed.
    Speed,
}

/// A `/control` request.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Control {
    /// Action.
    pub action: Action,
    /// Number of ticks for `step`; 1 if omitted.
    pub ticks: Option<u64>,
    /// Ratio of simulated to wall time, for `speed`; if omitted or 0, the limit is lifted.
    pub speed: Option<f64>,
}

/// A `/drive` request: the user's current inputs. Omitted fields keep their values.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Drive {
    /// Tension of each tendon, or of tendon 0 alone, N.
    pub tendon_n: Option<OneOrMany>,
    /// Speed along the tool's axis, m/s; forward is positive.
    pub insert_m_per_s: Option<f64>,
    /// Angular speed of the burr, rad/s.
    pub burr_rad_per_s: Option<f64>,
    /// Pose of the C-arm; requests a frame.
    pub c_arm: Option<CArm>,
}

/// One number or several.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum OneOrMany {
    /// One.
    One(f64),
    /// Several.
    Many(Vec<f64>),
}

impl OneOrMany {
    /// The values.
    pub fn values(&self) -> &[f64] {
        match self {
            OneOrMany::One(value) => std::slice::from_ref(value),
            OneOrMany::Many(values) => values,
        }
    }
}

/// C-arm pose, given either as DICOM angles (0018,1510 and 0018,1511) about the scene's isocentre or as a
/// pose.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct CArm {
    /// Positive toward the patient's left, degrees.
    pub primary_angle_deg: Option<f64>,
    /// Positive is cranial, degrees.
    pub secondary_angle_deg: Option<f64>,
    /// Isocentre and axes (x right, y down in the image, z to the source).
    pub pose: Option<Pose>,
}

/// A pose in the patient frame.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Pose {
    /// Origin.
    pub position_m: [f64; 3],
    /// Unit quaternion x, y, z, w.
    pub orientation_xyzw: [f64; 4],
}

/// A `/playback` request.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Playback {
    /// Action.
    pub action: PlaybackAction,
    /// Target time for `seek`, ns.
    pub time_ns: Option<u64>,
    /// Ratio of simulated to wall time, for `speed`; negative plays backward.
    pub speed: Option<f64>,
    /// Kind of mark for `next` and `previous`: event, miss, divergence or gap; `None` matches all.
    pub kind: Option<String>,
    /// Number of ticks for `step`, negative for backward; 1 if omitted.
    pub ticks: Option<i64>,
}

/// Actions of `/playback`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlaybackAction {
    /// Play from here.
    Play,
    /// Pause.
    Pause,
    /// Jump to a time.
    Seek,
    /// Set the speed.
    Speed,
    /// Advance some ticks.
    Step,
    /// Jump to the next mark.
    Next,
    /// Jump to the previous mark.
    Previous,
}

/// Points of a plan in the patient frame, mm. Omitted points stay where they are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Places {
    /// Centre of the burr before the first tick; the pilot hole that leads there moves with it.
    pub burr_start_mm: Option<[f64; 3]>,
    /// Centre of the burr at the end of the path.
    pub target_mm: Option<[f64; 3]>,
    /// Isocentre of the C-arm.
    pub isocentre_mm: Option<[f64; 3]>,
}

/// A `/plan` request, for a scene before its run.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "action", rename_all = "lowercase")]
pub enum PlanRequest {
    /// Moves points and publishes the new scene to all clients.
    Move {
        /// The new points.
        places: Places,
    },
    /// Undoes all moves.
    Restore,
    /// Writes the scene to the folder of the original file.
    Save {
        /// File name, without a folder.
        name: String,
        /// Whether an existing file of that name may be overwritten.
        #[serde(default)]
        replace: bool,
    },
    /// Runs the scene as last saved.
    Run,
}

/// A request whose format and token have been checked.
#[derive(Debug, Clone, PartialEq)]
pub enum Request {
    /// Control the run.
    Control(Control),
    /// Drive the tool.
    Drive(Drive),
    /// Render a frame from this pose.
    Frame(CArm),
    /// Move on the time line.
    Playback(Playback),
    /// Fields of a log over time.
    Series(SeriesRequest),
    /// Show a slice of the CT.
    Slice(Slice),
    /// Change, save or run a scene.
    Plan(PlanRequest),
}

/// Reply to a request that was executed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reply {
    /// Done, with no data to return.
    Done,
    /// A JSON object with `"ok": true` and the requested data.
    Json(String),
    /// The requested data in a binary encoding.
    Bytes {
        /// Name of the encoding.
        encoding: &'static str,
        /// The content.
        bytes: Vec<u8>,
    },
}

/// Result of a request: the reply, or an error text for the user.
pub type Outcome = Result<Reply, String>;

/// Returns whether a service's requests change something, so that they need the token.
pub(crate) fn is_command(service: u32) -> bool {
    service != SERIES && service != SLICE
}

/// Parses a request. Commands require the server's token; read requests only require a connection.
///
/// # Errors
/// An error text for the user.
pub fn read_request(service: u32, payload: &[u8], token: &str) -> Result<Request, String> {
    let value: Value = serde_json::from_slice(payload).map_err(|error| format!("not JSON: {error}"))?;
    let given = value.get("token").and_then(Value::as_str).unwrap_or("");
    if is_command(service) && !same(given, token) {
        return Err(NO_TOKEN.to_owned());
    }
    let malformed = |error: serde_json::Error| format!("malformed request: {error}");
    let request = match service {
        1 => Request::Control(serde_json::from_value(value).map_err(malformed)?),
        2 => Request::Drive(serde_json::from_value(value).map_err(malformed)?),
        3 => {
            #[derive(Deserialize)]
            struct Frame {
                pose: Option<Pose>,
                #[serde(flatten)]
                c_arm: CArm,
            }
            let frame: Frame = serde_json::from_value(value).map_err(malformed)?;
            Request::Frame(CArm { pose: frame.pose.or(frame.c_arm.pose), ..frame.c_arm })
        }
        4 => Request::Playback(serde_json::from_value(value).map_err(malformed)?),
        SERIES => Request::Series(serde_json::from_value(value).map_err(malformed)?),
        SLICE => Request::Slice(serde_json::from_value(value).map_err(malformed)?),
        PLAN => Request::Plan(serde_json::from_value(value).map_err(malformed)?),
        other => return Err(format!("there is no service {other}")),
    };
    Ok(request)
}

/// Reply to a client with a missing or wrong token.
pub(crate) const NO_TOKEN: &str =
    "missing or wrong token: open the page with the address that the viewer printed";

/// Compares two tokens in constant time, so that timing does not reveal where they differ.
pub(crate) fn same(given: &str, token: &str) -> bool {
    let difference = given.bytes().zip(token.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
    given.len() == token.len() && difference == 0
}

/// Returns the encoding and bytes of a reply; the encoding is JSON unless the reply has its own.
pub fn response(outcome: Outcome) -> (&'static str, Vec<u8>) {
    let text = match outcome {
        Ok(Reply::Done) => json!({"ok": true}).to_string(),
        Ok(Reply::Json(text)) => text,
        Ok(Reply::Bytes { encoding, bytes }) => return (encoding, bytes),
        Err(error) => json!({"ok": false, "error": error}).to_string(),
    };
    ("json", text.into_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_whole_token_opens() {
        let request = |token: &str| {
            let body = format!(r#"{{"token":"{token}","action":"pause"}}"#);
            read_request(1, body.as_bytes(), "c0ffee")
        };
        let pause = Control { action: Action::Pause, ticks: None, speed: None };
        assert_eq!(request("c0ffee"), Ok(Request::Control(pause)));
        for wrong in ["", "c0ffe", "c0ffeee", "C0ffee"] {
            assert!(request(wrong).is_err_and(|error| error.contains("token")), "{wrong}");
        }
        assert!(read_request(1, b"{\"action\":\"pause\"}", "c0ffee").is_err());
    }

    #[test]
    fn a_plan_is_changed_only_with_the_token() {
        let read = |body: &str| read_request(7, body.as_bytes(), "t");
        let places = Places { target_mm: Some([1.0, 2.0, 3.5]), ..Places::default() };
        let moved = r#"{"token":"t","action":"move","places":{"target_mm":[1,2,3.5]}}"#;
        assert_eq!(read(moved), Ok(Request::Plan(PlanRequest::Move { places })));
        let save = PlanRequest::Save { name: "a.toml".to_owned(), replace: false };
        assert_eq!(read(r#"{"token":"t","action":"save","name":"a.toml"}"#), Ok(Request::Plan(save)));
        for (body, said) in [
            (moved.replace("\"t\"", "\"x\""), "token"),
            (moved.replace("target_mm", "target_m"), "target_m"),
            (moved.replace("[1,2,3.5]", "[1,2]"), "length"),
            (r#"{"token":"t","action":"delete"}"#.to_owned(), "delete"),
        ] {
            let error = read(&body).unwrap_err();
            assert!(error.contains(said), "{body}: {error}");
        }
    }

    #[test]
    fn a_frame_is_asked_for_by_angles_or_by_pose() {
        let body = br#"{"token":"t","primary_angle_deg":30}"#;
        let expected = CArm { primary_angle_deg: Some(30.0), ..CArm::default() };
        assert_eq!(read_request(3, body, "t"), Ok(Request::Frame(expected)));
        let body = br#"{"token":"t","pose":{"position_m":[0,0,0],"orientation_xyzw":[0,0,0,1]}}"#;
        let pose = Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        assert_eq!(
            read_request(3, body, "t"),
            Ok(Request::Frame(CArm { pose: Some(pose), ..CArm::default() }))
        );
    }
}
