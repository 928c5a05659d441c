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
