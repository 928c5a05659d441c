//! The parts of a session.

use std::fmt::{self, Display, Formatter};

/// The parts of a session, besides its controllers and clients. Each is exactly one program. The numbers are
/// those of [`Event::sender`](crate::Event::sender).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u32)]
pub enum Part {
    /// The launcher, or another program that created the session.
    Host = 0,
    /// The physics process.
    Physics = 1,
    /// The DRR process.
    Drr = 2,
    /// The recorder process.
    Recorder = 3,
}

impl Part {
    /// All parts.
    pub const ALL: [Part; 4] = [Part::Host, Part::Physics, Part::Drr, Part::Recorder];

    /// Returns its name, which no controller may have: the name of its program, also used in summaries and in
    /// the reason why a run ended.
    pub const fn name(self) -> &'static str {
        match self {
            Part::Host => "launcher",
            Part::Physics => "physics",
            Part::Drr => "drr",
            Part::Recorder => "recorder",
        }
    }
}

/// Displays its role, for the middle of a sentence.
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
