//! Charts: measured figures as SVG and CSV.

pub mod drr;
