//! Parts of a data set, for training and for judging what was trained: by whole runs, since frames of one run look alike.

use std::collections::BTreeMap;
use std::str::FromStr;

use sha2::{Digest, Sha256};

/// A part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// To train on.
    Train,
    /// To choose by.
    Val,
    /// To judge by.
    Test,
}

impl Part {
    const ALL: [Part; 3] = [Part::Train, Part::Val, Part::Test];

    /// Its name: `train`, `val`, `test`.
    pub fn name(self) -> &'static str {
        match self {
            Part::Train => "train",
            Part::Val => "val",
            Part::Test => "test",
        }
    }
}

/// The share of each part, written `train=0.8,val=0.1,test=0.1`: above 0, together 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Shares(BTreeMap<Part, f64>);

/// How far the shares' sum may be from 1: three numbers of a few digits.
const SUM_ERROR: f64 = 1e-6;

impl FromStr for Shares {
    type Err = String;

    fn from_str(text: &str) -> Result<Shares, String> {
        let mut shares = BTreeMap::new();
        for word in text.split(',') {
            let (name, share) = word
                .split_once('=')
                .ok_or_else(|| format!("`{word}`: expected NAME=SHARE, such as train=0.8"))?;
            let part = Part::ALL.into_iter().find(|part| part.name() == name);
            let part = part.ok_or_else(|| format!("`{name}`: the parts are train, val and test"))?;
            let number = share.parse::<f64>().ok().filter(|share| *share > 0.0 && *share <= 1.0);
            let share = number.ok_or_else(|| format!("`{word}`: the share is a number above 0, up to 1"))?;
            if shares.insert(part, share).is_some() {
                return Err(format!("`{name}` is given twice"));
            }
        }
        let sum: f64 = shares.values().sum();
        if (sum - 1.0).abs() > SUM_ERROR {
            return Err(format!("the shares make {sum}, expected 1"));
        }
        Ok(Shares(shares))
    }
}

impl Shares {
    /// Whether there is such a part.
    pub fn has(&self, part: Part) -> bool {
        self.0.contains_key(&part)
    }

    /// The part of each run, given by what tells it from others; runs that nothing tells apart stay together. The runs are ordered by the
    /// SHA-256 of the seed and their text, and dealt out in the parts' order: as many to each as its share says, to the nearest whole
    /// number, but one at least.
    ///
    /// # Errors
    /// Fewer different runs than parts, in words.
    pub fn deal(&self, runs: &[String], seed: u64) -> Result<Vec<Part>, String> {
        let key = |run: &String| {
            let digest = Sha256::new_with_prefix(seed.to_le_bytes()).chain_update(run.as_bytes()).finalize();
            (digest.to_vec(), run.clone())
        };
        let mut groups: Vec<_> = runs.iter().map(key).collect();
        groups.sort_unstable();
        groups.dedup();
        let (count, parts) = (groups.len(), self.0.len());
        if count < parts {
            return Err(format!(
                "{parts} parts of {count} different runs; give at least one run for each part"
            ));
        }
        let mut dealt: BTreeMap<&String, Part> = BTreeMap::new();
        let (mut sum, mut begin) = (0.0, 0);
        for (number, (part, share)) in self.0.iter().enumerate() {
            sum += share;
            // Every part gets one, and leaves one for each that follows.
            let end = ((sum * count as f64).round() as usize).clamp(begin + 1, count + 1 + number - parts);
            dealt.extend(groups[begin..end].iter().map(|(_, run)| (run, *part)));
            begin = end;
        }
        Ok(runs.iter().filter_map(|run| dealt.get(run).copied()).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs(count: usize) -> Vec<String> {
        (0..count).map(|number| format!("run {number}")).collect()
    }

    fn counts(shares: &str, count: usize, seed: u64) -> [usize; 3] {
        let dealt = shares.parse::<Shares>().unwrap().deal(&runs(count), seed).unwrap();
        assert_eq!(dealt.len(), count);
        Part::ALL.map(|part| dealt.iter().filter(|other| **other == part).count())
    }

    #[test]
    fn each_part_gets_its_share_and_one_run_at_least() {
        for seed in 0..20 {
            assert_eq!(counts("train=0.8,val=0.1,test=0.1", 64, seed), [51, 7, 6]);
            assert_eq!(counts("train=0.8,val=0.1,test=0.1", 3, seed), [1, 1, 1]);
            assert_eq!(counts("test=0.01,train=0.99", 5, seed), [4, 0, 1]);
            assert_eq!(counts("train=1", 5, seed), [5, 0, 0]);
        }
        let refused = "train=0.5,val=0.5".parse::<Shares>().unwrap().deal(&runs(1), 0);
        assert!(refused.is_err_and(|words| words.contains("2 parts of 1 different runs")));
    }

    #[test]
    fn runs_are_dealt_by_seed_and_text_and_equal_ones_stay_together() {
        let shares: Shares = "train=0.5,test=0.5".parse().unwrap();
        let (forward, mut backward) = (runs(20), runs(20));
        backward.reverse();
        let dealt = shares.deal(&forward, 7).unwrap();
        let mut again = shares.deal(&backward, 7).unwrap();
        again.reverse();
        assert_eq!(dealt, again, "the order in which they are given changes nothing");
        assert_ne!(dealt, shares.deal(&forward, 8).unwrap());
        let twice = [forward.clone(), forward].concat();
        let dealt = shares.deal(&twice, 7).unwrap();
        assert_eq!(dealt[..20], dealt[20..]);
    }

    #[test]
    fn what_is_no_split_is_refused_in_words() {
        for (text, expected) in [
            ("train", "expected NAME=SHARE"),
            ("learn=1", "train, val and test"),
            ("train=0.8,val=0.1", "0.9"),
            ("train=0.5,train=0.5", "twice"),
            ("train=0,val=1", "above 0"),
            ("train=NaN", "above 0"),
            ("", "expected NAME=SHARE"),
        ] {
            let refused = text.parse::<Shares>().unwrap_err();
            assert!(refused.contains(expected), "{text}: {refused}");
        }
    }
}
