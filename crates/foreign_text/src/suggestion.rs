//! "Did you mean" suggestions for a wrong name.

/// Similarity (Jaro-Winkler) above which a valid name is suggested for a wrong one, as in clap.
const NEAR_ENOUGH: f64 = 0.7;

/// Returns the valid name that is nearest to a wrong one; `None` if none is similar.
pub fn nearest_name<'a>(wrong: &str, valid: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let near = |name: &str| strsim::jaro_winkler(name, wrong);
    let nearest = valid.into_iter().max_by(|a, b| near(a).total_cmp(&near(b)))?;
    (near(nearest) > NEAR_ENOUGH).then_some(nearest)
}
