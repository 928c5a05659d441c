//! Small scenes.

/// The tool's start: in front of the block, with 3.25 mm of air between burr and bone.
const TOOL: &str = "
[tool]
burr_start_mm = [0.0, 0.0, -34.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
";

const DRR: &str = "
[drr]
rate_hz = 10.0
isocentre_mm = [0.0, 0.0, -20.0]
columns = 64
rows = 64
pixel_pitch_mm = 1.5
photons_per_pixel = 5000.0
threads = 1
";

/// The block phantom, 35 x 35 x 55 mm with 2.5 mm of air around it, centred on the origin.
const BLOCK: &str = "
[volume]
phantom = \"block\"
spacing_mm = 1.0
";

const DRILL: &str = "
[[controller]]
name = \"reference\"
drives = [\"tendon\", \"arm\", \"burr\"]

[controller.curved_drilling]
feed_mm_per_s = 8.0
insertion_mm = 20.0
tension_n = 6.0
ramp_start_mm = 1.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
";

/// A plan in the ball of `phantom sphere`, whose radius is 10 mm and whose centre is the origin: straight to
/// its centre.
pub const PLAN_OF_THE_BALL: &str =
    "# CoordinateSystem = LPS\n1,0,0,-12,0,0,0,1,1,1,0,entry,,\n2,0,0,0,0,0,0,1,1,1,0,target,,\n";

fn run(name: &str, mode: &str, duration_s: f64) -> String {
    format!("name = \"{name}\"\n[run]\nmode = \"{mode}\"\nduration_s = {duration_s:?}\nseed = 7\n")
}

/// A controller that holds a tension in free space: no volume, no X-ray.
pub fn hold(mode: &str, duration_s: f64) -> String {
    let controller = "[[controller]]\nname = \"holder\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nhold = { tension_n = 2.0 }\n";
    format!("{}{TOOL}{controller}", run("hold", mode, duration_s))
}

/// Curved drilling into the block with X-ray frames: every part takes part.
pub fn drill(mode: &str, duration_s: f64) -> String {
    format!("{}{BLOCK}{TOOL}{DRR}{DRILL}", run("drill", mode, duration_s))
}

/// The same without X-ray.
pub fn drill_unseen(mode: &str, duration_s: f64) -> String {
    format!("{}{BLOCK}{TOOL}{DRILL}", run("drill", mode, duration_s))
}

/// The same with a volume file next to the scene.
pub fn drill_in_file(mode: &str, duration_s: f64, file: &str) -> String {
    let volume = format!("[volume]\npath = {file:?}\n");
    format!("{}{volume}{TOOL}{DRR}{DRILL}", run("drill", mode, duration_s))
}

/// The block, drilled by a controller `pilot`, which is the test itself; `more` follows the `[run]` keys.
pub fn piloted(mode: &str, duration_s: f64, more: &str) -> String {
    let run = run("piloted", mode, duration_s);
    let pilot =
        "[[controller]]\nname = \"pilot\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n";
    format!("{run}{more}\n{BLOCK}{TOOL}{pilot}")
}

/// A `pilot` for tendons and arm, and a built-in `holder` for the burr, in free space.
pub fn shared(mode: &str, duration_s: f64) -> String {
    let controllers = "
[[controller]]
name = \"pilot\"
drives = [\"tendon\", \"arm\"]
external = true

[[controller]]
name = \"holder\"
drives = [\"burr\"]
hold = { tension_n = 0.0 }
";
    format!("{}{TOOL}{controllers}", run("shared", mode, duration_s))
}

/// Keyframes at an interval in seconds; to be appended to a scene's text.
pub fn keyframes(interval_s: f64) -> String {
    format!("\n[recording]\nkeyframe_interval_s = {interval_s:?}\n")
}

/// The block in real time, driven by an external `pilot`, with or without X-ray; late commands are soon
/// replaced.
pub fn scheduled(duration_s: f64, with_frames: bool) -> String {
    let frames = if with_frames { DRR } else { "" };
    let scene = piloted("realtime", duration_s, "hold_ticks = 20");
    // 2.55 mm from the bone, so that moving forward soon drills.
    let scene = scene.replace("[0.0, 0.0, -34.0]", "[0.0, 0.0, -33.3]");
    format!("{scene}{frames}{}", keyframes(0.3))
}
