//! Parts of scenes.

/// The tool along +z with the burr at the origin, tendon 0 toward +x, and a controller that drives everything.
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
