//! How much of a chart or an experiment is computed.

/// How much to compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// A few points, in seconds.
    Quick,
    /// All points.
    Full,
}

impl Effort {
    /// What the option `--quick` asks for.
    pub fn of_option(quick: bool) -> Effort {
        if quick { Effort::Quick } else { Effort::Full }
    }
}
