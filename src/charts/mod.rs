//! Charts: measured figures of the physics as SVG, PNG and CSV.

pub mod method;
pub mod physics;
pub mod stability;
