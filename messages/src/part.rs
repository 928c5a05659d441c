//! The parts of a session.

use std::fmt::{self, Display, Formatter};

/// The parts of a session, besides its controllers and clients. Each is exactly one program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The launcher, or another program that created the session.
    Host,
    /// The physics process.
    Physics,
    /// The DRR process.
    Drr,
    /// The recorder process.
    Recorder,
}

impl Part {
    /// All of them.
    pub const ALL: [Part; 4] = [Part::Host, Part::Physics, Part::Drr, Part::Recorder];
}

impl Display for Part {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Part::Host => "the host",
            Part::Physics => "the physics",
            Part::Drr => "the DRR process",
            Part::Recorder => "the recorder process",
        })
    }
}
