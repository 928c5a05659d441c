//! Charts: measured figures as SVG, PNG and CSV.

pub mod coverage;
pub mod drr;
pub mod flexure;
pub mod method;
mod peers;
pub mod physics;
pub mod stability;
