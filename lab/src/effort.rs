//! Amount of work for a chart or an experiment.

/// Amount of work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// A few points, in seconds.
    Quick,
    /// All points.
    Full,
}

impl Effort {
    /// Converts the option `--quick`.
    pub fn of_option(quick: bool) -> Effort {
        if quick { Effort::Quick } else { Effort::Full }
    }
}
