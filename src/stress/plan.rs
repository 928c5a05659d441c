//! Chooses the combinations to run.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use fastrand::Rng;
use ipc_types::scene::{Policy, Wait};
use serde::{Deserialize, Serialize};

/// Kind of competing load on the hub's cores.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum LoadKind {
    /// Computes in an endless loop.
    Spin,
    /// Reads and writes randomly in 64 MiB of memory.
    Memory,
    /// Writes to the disk of the output folder and syncs.
    Disk,
    /// Starts a process, waits for it to end, repeats.
    Fork,
}

impl LoadKind {
    /// All kinds, with their names.
    pub const ALL: [(LoadKind, &'static str); 4] = [
        (LoadKind::Spin, "spin"),
        (LoadKind::Memory, "memory"),
        (LoadKind::Disk, "disk"),
        (LoadKind::Fork, "fork"),
    ];

    /// Returns its name.
    pub fn name(self) -> &'static str {
        Self::ALL.into_iter().find(|(kind, _)| *kind == self).map_or("", |(_, name)| name)
    }
}

/// Competing load on the hub's cores: `none`, or a kind and a count, such as `spin:2`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Load {
    /// Kind of the processes; `None` without load.
    pub kind: Option<LoadKind>,
    /// Number of processes.
    pub count: usize,
}

/// Maximum number of load processes in a combination.
const MAX_COUNT: usize = 64;

impl FromStr for Load {
    type Err = String;

    fn from_str(text: &str) -> Result<Load, String> {
        if text == "none" {
            return Ok(Load { kind: None, count: 0 });
        }
        let (name, count) = text.split_once(':').unwrap_or((text, "1"));
        let kind = LoadKind::ALL.into_iter().find(|(_, known)| *known == name).map(|(kind, _)| kind);
        let count = count.parse::<usize>().ok().filter(|count| (1..=MAX_COUNT).contains(count));
        match (kind, count) {
            (Some(kind), Some(count)) => Ok(Load { kind: Some(kind), count }),
            _ => Err(format!(
                "unknown load `{text}`; expected `none`, `spin`, `memory`, `disk` or `fork`, with `:N` for \
                 N of them, 1 to {MAX_COUNT}"
            )),
        }
    }
}

impl fmt::Display for Load {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.kind, self.count) {
            (None, _) => out.write_str("none"),
            (Some(kind), 1) => out.write_str(kind.name()),
            (Some(kind), count) => write!(out, "{}:{count}", kind.name()),
        }
    }
}

impl From<Load> for String {
    fn from(load: Load) -> String {
        load.to_string()
    }
}

impl TryFrom<String> for Load {
    type Error = String;

    fn try_from(text: String) -> Result<Load, String> {
        text.parse()
    }
}

/// One combination.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Combination {
    /// Number of cores for the whole hub and the load.
    pub cores: usize,
    /// Competing load.
    pub load: Load,
    /// Scheduling policy of physics and controllers.
    pub policy: Policy,
    /// How physics and controllers wait.
    pub wait: Wait,
}

/// `other` or `fifo`.
pub fn policy_name(policy: Policy) -> &'static str {
    match policy {
        Policy::Other => "other",
        Policy::Fifo => "fifo",
    }
}

/// `spin`, `event` or `hybrid`.
pub fn wait_name(wait: Wait) -> &'static str {
    match wait {
        Wait::Spin => "spin",
        Wait::Event => "event",
        Wait::Hybrid => "hybrid",
    }
}

impl fmt::Display for Combination {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cores = if self.cores == 1 { "1 core".to_owned() } else { format!("{} cores", self.cores) };
        let (policy, wait) = (policy_name(self.policy), wait_name(self.wait));
        write!(out, "{cores}, load {}, {policy}, {wait}", self.load)
    }
}

/// Returns all combinations of the levels, the last factor varying fastest; duplicate levels count once.
pub fn all(cores: &[usize], loads: &[Load], policies: &[Policy], waits: &[Wait]) -> Vec<Combination> {
    let mut combinations = Vec::new();
    for &cores in cores {
        for &load in loads {
            for &policy in policies {
                for &wait in waits {
                    let combination = Combination { cores, load, policy, wait };
                    if !combinations.contains(&combination) {
                        combinations.push(combination);
                    }
                }
            }
        }
    }
    combinations
}

/// A pair of levels of two factors, by the factors' indices and the levels' names.
type Pair = (usize, String, usize, String);

fn pairs(combination: &Combination) -> Vec<Pair> {
    let Combination { cores, load, policy, wait } = combination;
    let levels =
        [cores.to_string(), load.to_string(), policy_name(*policy).to_owned(), wait_name(*wait).to_owned()];
    let mut pairs = Vec::new();
    for first in 0..levels.len() {
        for second in first + 1..levels.len() {
            pairs.push((first, levels[first].clone(), second, levels[second].clone()));
        }
    }
    pairs
}

/// Chooses `count` of the combinations, keeping their order, to cover as many pairs of levels as possible.
/// Greedy: each step picks the combination that covers the most uncovered pairs; the seed breaks ties.
pub fn subset(combinations: &[Combination], count: usize, seed: u64) -> Vec<Combination> {
    let mut random = Rng::with_seed(seed);
    let mut left: Vec<(u64, usize)> = (0..combinations.len()).map(|index| (random.u64(..), index)).collect();
    left.sort_unstable();
    let mut seen: BTreeSet<Pair> = BTreeSet::new();
    let mut chosen: BTreeSet<usize> = BTreeSet::new();
    while chosen.len() < count.min(combinations.len()) {
        let fresh =
            |index: usize| pairs(&combinations[index]).into_iter().filter(|p| !seen.contains(p)).count();
        let counts = left.iter().enumerate().map(|(at, (_, index))| (fresh(*index), at));
        // On a tie, the first in the seed's order.
        let Some((_, at)) = counts.max_by_key(|(fresh, at)| (*fresh, std::cmp::Reverse(*at))) else { break };
        let (_, index) = left.remove(at);
        seen.extend(pairs(&combinations[index]));
        chosen.insert(index);
    }
    chosen.into_iter().map(|index| combinations[index]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn loads(text: &[&str]) -> Vec<Load> {
        text.iter().map(|load| load.parse().unwrap()).collect()
    }

    #[test]
    fn loads_are_read_and_written() {
        for text in ["none", "spin", "spin:2", "memory", "disk:3", "fork"] {
            assert_eq!(text.parse::<Load>().unwrap().to_string(), text);
        }
        for text in ["", "spin:0", "spin:65", "spin:x", "none:1", "burn", "spin:-1"] {
            assert!(text.parse::<Load>().unwrap_err().contains("expected `none`, `spin`"), "{text}");
        }
    }

    #[test]
    fn a_subset_of_two_thirds_of_a_factorial_holds_every_pair() {
        let loads = loads(&["none", "spin:2", "disk"]);
        let waits = [Wait::Spin, Wait::Event, Wait::Hybrid];
        let whole = all(&[1, 2], &loads, &[Policy::Other, Policy::Fifo], &waits);
        assert_eq!(whole.len(), 36);
        let every: BTreeSet<Pair> = whole.iter().flat_map(pairs).collect();
        for seed in 0..20 {
            let some = subset(&whole, 12, seed);
            let held: BTreeSet<Pair> = some.iter().flat_map(pairs).collect();
            assert_eq!((some.len(), held.len()), (12, every.len()), "seed {seed}");
            assert_eq!(some, subset(&whole, 12, seed), "the seed decides");
            assert!(some.windows(2).all(|pair| {
                let place = |c: &Combination| whole.iter().position(|other| other == c).unwrap();
                place(&pair[0]) < place(&pair[1])
            }));
        }
        assert_ne!(subset(&whole, 12, 1), subset(&whole, 12, 2));
        assert_eq!(subset(&whole, 99, 1), whole);
    }

    #[test]
    fn a_level_that_stands_twice_counts_once() {
        let twice = loads(&["none", "none"]);
        assert_eq!(all(&[1, 1], &twice, &[Policy::Other], &[Wait::Event, Wait::Event]).len(), 1);
    }
}
