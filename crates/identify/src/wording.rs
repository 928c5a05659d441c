//! Combinations of parameters in words.

use sweep::Scale;

use crate::parameter::Parameter;
use crate::uncertainty::{Combination, Uncertainty};

/// Smallest component of a direction, relative to the largest, that is named.
const NAMED: f64 = 0.1;
/// Step along a direction, as a share of the range, that a sentence speaks of.
const STEP: f64 = 0.1;

/// Says which parameters and combinations the data do not determine, one sentence each.
pub fn undetermined(parameters: &[Parameter], uncertainty: &Uncertainty) -> Vec<String> {
    let open = uncertainty.combinations.iter().filter(|combination| !combination.is_determined);
    open.map(|combination| sentence(parameters, combination)).collect()
}

fn sentence(parameters: &[Parameter], combination: &Combination) -> String {
    let largest = combination.direction.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    let named: Vec<(&Parameter, f64)> = parameters
        .iter()
        .zip(&combination.direction)
        .filter(|(_, x)| x.abs() >= NAMED * largest)
        .map(|(parameter, x)| (parameter, x / largest))
        .collect();
    let moved = STEP / largest * combination.singular_value;
    if let [(parameter, _)] = named.as_slice() {
        return format!(
            "the data do not determine `{}`: a step of {} of its range changes the residuals by {} in all",
            parameter.key,
            percent(STEP),
            deviations(moved)
        );
    }
    let names: Vec<String> = named.iter().map(|(parameter, _)| format!("`{}`", parameter.key)).collect();
    let changes: Vec<String> =
        named.iter().map(|(parameter, share)| change(parameter, STEP * share)).collect();
    format!(
        "the data determine only {} of {}: changing {} together changes the residuals by {} in all; fix one \
         of them, give it a prior, or measure another quantity",
        if named.len() == 2 { "one combination" } else { "fewer combinations" },
        joined(&names),
        joined(&changes),
        deviations(moved),
    )
}

/// Describes a step of a parameter, as a share of its range.
fn change(parameter: &Parameter, share: f64) -> String {
    match parameter.scale {
        Scale::Log => {
            let factor = libm::pow(parameter.max / parameter.min, share);
            format!("`{}` by a factor of {factor:.3}", parameter.key)
        }
        Scale::Linear => {
            format!("`{}` by {:+.3}", parameter.key, share * (parameter.max - parameter.min))
        }
    }
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

fn deviations(moved: f64) -> String {
    match moved {
        _ if moved < 0.005 => "less than 0.01 standard deviations of the noise".to_owned(),
        _ => format!("{moved:.2} standard deviations of the noise"),
    }
}

/// Joins words by commas and a final "and".
pub fn joined(words: &[String]) -> String {
    match words {
        [] => String::new(),
        [one] => one.clone(),
        [most @ .., last] => format!("{} and {last}", most.join(", ")),
    }
}
