//! The faults of a log. One function gives every command the same answer.

use std::fmt;
use std::io::Write;

use crate::continuity::Gap;
use crate::end::{Ending, TruncationPoint};
use crate::error::LogError;
use crate::opening::HeaderCopy;
use crate::source::LogSource;
use crate::stream::{MessageStream, ReadOptions};

/// A fault of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// One copy of the header cannot be read; the other one is used.
    HeaderDamaged {
        /// The unreadable copy.
        copy: HeaderCopy,
        /// The fault.
        cause: String,
    },
    /// Messages are missing between others, or never reached the log.
    Gap(Gap),
    /// Bytes have changed; only `repair` reads past them.
    Damaged {
        /// Where the damaged record begins.
        offset: u64,
        /// The fault.
        cause: String,
    },
    /// The file is truncated.
    Cut {
        /// Where it stops.
        cut: TruncationPoint,
        /// Whether the end marker survives, in which case no message is missing.
        ended: bool,
    },
    /// The file is whole, but the recorder did not finish it.
    NotEnded,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Fault::HeaderDamaged { copy, cause } => {
                write!(
                    f,
                    "header damaged: the copy {} is unreadable ({cause}); using the other one",
                    copy.name()
                )
            }
            Fault::Gap(gap) => {
                let lost: Vec<String> = gap.lost.iter().map(|(topic, n)| format!("{n} of {topic}")).collect();
                write!(f, "gap: missing messages: {}", lost.join(", "))?;
                gap.stretches.iter().try_for_each(|stretch| write!(f, "\n  {stretch}"))?;
                if gap.more > 0 {
                    write!(f, "\n  and {} more stretches", gap.more)?;
                }
                Ok(())
            }
            Fault::Damaged { offset, cause } => {
                write!(f, "damaged at byte {offset}: {cause}; `trabecula log repair` recovers what follows")
            }
            Fault::Cut { cut: TruncationPoint { offset, incomplete_bytes }, ended } => {
                let lost = if *ended { "no message is missing" } else { "what followed is unknown" };
                write!(
                    f,
                    "truncated after byte {offset}, {incomplete_bytes} bytes of an incomplete record \
                     skipped: {lost}"
                )
            }
            Fault::NotEnded => {
                f.write_str("not ended: the recorder did not finish, later ticks may be missing")
            }
        }
    }
}

/// Everything that is wrong with a log; empty if it is intact.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Verdict {
    /// The faults.
    pub faults: Vec<Fault>,
    /// How the file ends.
    pub ending: Ending,
}

impl Verdict {
    /// Returns true if nothing is wrong.
    pub fn is_intact(&self) -> bool {
        self.faults.is_empty()
    }

    /// Whether damage stopped the reader, so that nothing after it was read.
    pub fn is_stopped_by_damage(&self) -> bool {
        self.faults.iter().any(|fault| matches!(fault, Fault::Damaged { .. }))
    }

    /// Writes the verdict as text, one fault per line.
    ///
    /// # Errors
    /// Any error of the output.
    pub fn write(&self, out: &mut dyn Write) -> Result<(), LogError> {
        writeln!(out, "verdict     {self}")?;
        Ok(())
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_intact() {
            return f.write_str("intact");
        }
        for (index, fault) in self.faults.iter().enumerate() {
            let line = if index > 0 { "\n" } else { "" };
            write!(f, "{line}{fault}")?;
        }
        Ok(())
    }
}

/// Reads a log of either lane to its end, or as far as possible.
///
/// # Errors
/// Not a log: not an MCAP file, no readable copy of the header, or message layouts of another build.
pub fn verdict(log: &dyn LogSource, options: ReadOptions) -> Result<Verdict, LogError> {
    let mut stream = MessageStream::open(log, options)?;
    while let Ok(Some(_)) = stream.next_message() {}
    Ok(stream.verdict())
}
