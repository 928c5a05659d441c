//! Splits a data set into training, validation and test parts.

use sha2::{Digest, Sha256};

/// Names of parts.
const NAMES: [&str; 3] = ["train", "val", "test"];

/// Share of the runs for each part.
#[derive(Debug, Clone, PartialEq)]
pub struct Split {
    parts: Vec<(&'static str, f64)>,
}

impl Split {
    /// Parses `train=0.8,val=0.1,test=0.1`.
    ///
    /// # Errors
    /// Malformed text, an unknown or duplicate name, a share outside 0 to 1, or a sum other than 1; as text.
    pub fn parse(text: &str) -> Result<Split, String> {
        let mut parts: Vec<(&'static str, f64)> = Vec::new();
        for part in text.split(',') {
            let (given, share) = part.split_once('=').ok_or_else(|| {
                format!("`{part}` is not of the form NAME=SHARE, as in train=0.8,val=0.1,test=0.1")
            })?;
            let name = NAMES.into_iter().find(|name| *name == given);
            let name =
                name.ok_or_else(|| format!("unknown part `{given}`, expected one of {}", NAMES.join(", ")))?;
            if parts.iter().any(|(other, _)| *other == name) {
                return Err(format!("duplicate part `{name}`"));
            }
            match share.parse::<f64>() {
                Ok(share) if share > 0.0 && share <= 1.0 => parts.push((name, share)),
                _ => return Err(format!("`{name}` is {share}; allowed: a share above 0, at most 1")),
            }
        }
        let sum: f64 = parts.iter().map(|(_, share)| share).sum();
        if (sum - 1.0).abs() > 1e-9 {
            return Err(format!("the shares add up to {sum}, expected 1"));
        }
        Ok(Split { parts })
    }

    /// Returns the names of its parts in the given order.
    pub fn names(&self) -> Vec<&'static str> {
        self.parts.iter().map(|(name, _)| *name).collect()
    }

    /// Returns the part of a run, which depends only on the seed and the run, so that adding runs does not
    /// move others. The first 53 bits of the SHA-256 of `SEED RUN` are a number from 0 to 1, a range that the
    /// parts divide in order.
    pub fn part_of(&self, seed: u64, run: &str) -> usize {
        let digest = Sha256::digest(format!("{seed} {run}").as_bytes());
        let bits = digest.iter().take(8).fold(0_u64, |bits, byte| bits << 8 | u64::from(*byte)) >> 11;
        let at = bits as f64 / (1_u64 << 53) as f64;
        let mut end = 0.0;
        let found = self.parts.iter().position(|(_, share)| {
            end += share;
            at < end
        });
        found.unwrap_or(self.parts.len() - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_split_is_refused_by_name() {
        for (given, expected) in [
            ("train", "NAME=SHARE"),
            ("dev=1", "unknown part `dev`, expected one of train, val, test"),
            ("train=0.5,train=0.5", "duplicate"),
            ("train=1.5", "allowed: a share above 0"),
            ("train=nan,val=1", "allowed: a share above 0"),
            ("train=0.8,val=0.1", "the shares add up to 0.9"),
            ("", "NAME=SHARE"),
        ] {
            let refused = Split::parse(given).unwrap_err();
            assert!(refused.contains(expected), "{given}: {refused}");
        }
    }

    #[test]
    fn shares_are_kept_and_a_seed_decides() {
        let split = Split::parse("train=0.7,val=0.2,test=0.1").unwrap();
        let counts = |seed: u64| {
            let mut counts = [0_i32; 3];
            (0..20_000).for_each(|run| counts[split.part_of(seed, &run.to_string())] += 1);
            counts
        };
        // Five standard deviations of a binomial of 20 000.
        for (count, want) in counts(1).into_iter().zip([14_000, 4_000, 2_000]) {
            assert!((count - want).abs() < 330, "{count} against {want}");
        }
        let parts = |seed| (0..64).map(|run| split.part_of(seed, &run.to_string())).collect::<Vec<_>>();
        assert_ne!(parts(1), parts(2));
        // By Python: int.from_bytes(hashlib.sha256(b"7 run").digest()[:8], "big") / 2**64 is 0.0527...
        assert_eq!(Split::parse("val=0.05,train=0.95").unwrap().part_of(7, "run"), 1);
        assert_eq!(Split::parse("val=0.06,train=0.94").unwrap().part_of(7, "run"), 0);
    }
}
