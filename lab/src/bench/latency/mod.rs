//! Measures the time from publishing a state to receiving the command that answers it, by language and wait
//! strategy, with plain iceoryx2 and sockets for comparison. All are measured alternately in one run, because
//! times depend on the machine, ratios less so.

mod cores;
mod hub;
mod peers;
mod sockets;

use std::path::PathBuf;

use clap::ValueEnum;
use ipc_types::messages::layout::Message;
use ipc_types::messages::{Command, State};
use serde_json::json;

pub use peers::answer;

use super::ping_pong::{self, Wait};
use super::samples::{Samples, median};
use crate::sheet::Sheet;
use cores::Cores;
use peers::Programs;
use trabecula::failure::Failure;
use trabecula::machine::Machine;

/// Round trips when both sides spin on a shared core: each takes two scheduler slices.
const SHARED_SPIN_ROUNDS: usize = 50;

/// The answering side.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Peer {
    /// Plain iceoryx2, messages of the same length.
    Iceoryx2,
    /// The Rust client.
    Rust,
    /// The C client.
    C,
    /// The Python client.
    Python,
    /// An FMU, as a controller with `fmu` runs it.
    Fmu,
    /// A Unix stream socket, messages of the same length.
    Unix,
    /// UDP over loopback, messages of the same length.
    Udp,
}

impl Peer {
    fn name(self) -> &'static str {
        match self {
            Peer::Iceoryx2 => "bare iceoryx2",
            Peer::Rust => "Rust client",
            Peer::C => "C client",
            Peer::Python => "Python client",
            Peer::Fmu => "FMU",
            Peer::Unix => "Unix socket",
            Peer::Udp => "UDP loopback",
        }
    }
}

/// Measurements of one peer.
#[derive(Debug, Default)]
struct Row {
    samples: Samples,
    ratios: Vec<f64>,
    absent: Option<String>,
}

/// Measures every peer `turns` times, alternating, with `rounds` round trips each, and prints the table.
///
/// # Errors
/// A transport that fails. A missing language is reported in its row.
pub fn run(rounds: usize, turns: usize, python: PathBuf, sheet: &mut Sheet) -> Result<(), Failure> {
    let machine = Machine::watch();
    let programs = Programs::prepare(python);
    let (state, command) = (State::DESCRIPTION.size, Command::DESCRIPTION.size);
    sheet.line(&format!(
        "round trip from state ({state} bytes) to command ({command} bytes), us; {turns} turns of {rounds} \
         each"
    ));
    for cores in Cores::available() {
        for wait in [Wait::Spin, Wait::Hybrid] {
            let shared_spin = wait == Wait::Spin && cores == Cores::One;
            let rounds = if shared_spin { SHARED_SPIN_ROUNDS } else { rounds };
            let how = if wait == Wait::Spin { "by spinning" } else { "by event" };
            sheet.line(&format!("\nwaiting {how}, {}", cores.name()));
            let head = format!("{:<16} {:>9} {:>9} {:>9} {:>10}", "", "p50", "p99", "p99.9", "x iceoryx2");
            sheet.line(&head);
            for (peer, row) in measure(&programs, cores, wait, rounds, turns)? {
                tell_row(peer, &row, sheet);
                let ratio = median(&row.ratios);
                sheet.push(
                    "round_trips",
                    json!({
                        "peer": peer.name(), "waiting": how, "cores": cores.name(),
                        "not_measured": row.absent,
                        "times": row.samples.figures(), "times_iceoryx2": ratio,
                    }),
                );
            }
        }
    }
    cores::release();
    sheet.line("");
    sheet.machine(&machine);
    Ok(())
}

fn measure(
    programs: &Programs,
    cores: Cores,
    wait: Wait,
    rounds: usize,
    turns: usize,
) -> Result<Vec<(Peer, Row)>, Failure> {
    let mut rows: Vec<(Peer, Row)> =
        Peer::value_variants().iter().map(|peer| (*peer, Row::default())).collect();
    for _ in 0..turns {
        let mut bare_us = 0.0;
        for (peer, row) in &mut rows {
            let samples = match peer {
                Peer::Iceoryx2 => ping_pong::measure_on(wait, rounds, |start| cores.apart(start))?,
                Peer::Unix | Peer::Udp => sockets::measure(*peer, wait, rounds, cores)?,
                Peer::Rust | Peer::C | Peer::Python | Peer::Fmu => {
                    match programs.command(*peer, wait, rounds) {
                        Ok(command) => hub::measure(command, wait, rounds, cores)?,
                        Err(reason) => {
                            row.absent = Some(reason);
                            continue;
                        }
                    }
                }
            };
            let p50_us = samples.quantile_us(0.5);
            if *peer == Peer::Iceoryx2 {
                bare_us = p50_us;
            }
            row.ratios.push(p50_us / bare_us);
            row.samples.append(&samples);
        }
    }
    Ok(rows)
}

fn tell_row(peer: Peer, row: &Row, sheet: &Sheet) {
    match &row.absent {
        Some(reason) => sheet.line(&format!("{:<16} not measured: {reason}", peer.name())),
        None => {
            let [p50, p99, p999] = [0.5, 0.99, 0.999].map(|fraction| row.samples.quantile_us(fraction));
            let ratio = median(&row.ratios);
            sheet.line(&format!("{:<16} {p50:9.2} {p99:9.2} {p999:9.2} {ratio:10.2}", peer.name()));
        }
    }
}
