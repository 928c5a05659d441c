//! Fragments of scenes.

/// The tool along +z with the burr at the origin, tendon 0 toward +x, and a controller that drives
/// everything.
pub const TOOL: &str = r#"
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[controller]]
name = "test"
drives = ["tendon", "arm", "burr"]
external = true
"#;

/// A block 0.25 mm in front of the burr, which a curve can be drilled into.
pub const BLOCK: &str = r#"
[volume]
phantom = "block"
spacing_mm = 1.0
[tool]
burr_start_mm = [0.0, 0.0, -31.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
"#;

/// A small X-ray of the block's drilled part, one thread, `rate_hz` frames per second.
pub fn x_ray(rate_hz: f64, rows: u32) -> String {
    format!(
        "[drr]\nrate_hz = {rate_hz:?}\nisocentre_mm = [0.0, 0.0, -20.0]\ncolumns = 64\nrows = {rows}\n\
         pixel_pitch_mm = 1.5\nphotons_per_pixel = 5000.0\nthreads = 1\n"
    )
}

/// A fibre and a tracker whose readings arrive late, some of them never.
pub const LATE_SENSORS: &str = r#"
[[sensor]]
name = "shape"
rate_hz = 100.0
delay_ms = 20.0
fbg = {}
[[sensor]]
name = "tracker"
rate_hz = 40.0
delay_ms = 20.0
jitter_ms = 10.0
dropout = 0.2
tracker = { on = "base", camera_mm = [0.0, 300.0, -900.0] }
"#;

/// A built-in controller `reference` that drills a curve into the block by its plan alone.
pub const OPEN_LOOP: &str = r#"
[[controller]]
name = "reference"
drives = ["tendon", "arm", "burr"]
[controller.curved_drilling]
feed_mm_per_s = 10.0
insertion_mm = 20.0
tension_n = 6.0
ramp_start_mm = 1.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
feedback = "none"
"#;

/// A tool file whose numbers are within their ranges, but whose tendon, pulled by newtons on flexures of a
/// micronewton metre, overflows.
pub const LIMP_TOOL: &str = "name = \"limp\"
tube = { outer_diameter_mm = 6.2, inner_diameter_mm = 3.1, linear_density_kg_per_m = 0.0001 }
stop = { angle_deg = 0.01, stiffness_nm_per_rad = 0.001 }
burr = { diameter_mm = 20.0, offset_mm = 500.0, mass_g = 0.0 }
tendon_cable = { stiffness_n_per_m = 1e9, friction = 1.0, gap_mm = 100.0 }
[[tendon]]
toward_mm = 2.5
[[flexure]]
at_mm = 0.01
count = 32
pitch_mm = 0.01
stiffness_nm_per_deg = 1e-6
rest_deg = 45.0
";
