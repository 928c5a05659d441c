//! Results as text.

use sim::identification::{CheckReport, ColumnReport, DesignReport, FitReport, MeasuredReport};

/// Formats a number with five significant digits.
pub(super) fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let digits = 4 - value.abs().log10().floor() as i32;
    match digits {
        -2..=9 => format!("{value:.*}", digits.max(0) as usize),
        _ => format!("{value:.4e}"),
    }
}

/// Returns the widest key.
fn width<'a>(keys: impl Iterator<Item = &'a str>) -> usize {
    keys.map(str::len).max().unwrap_or(0).max("parameter".len())
}

/// Formats a fit.
pub fn fit_text(report: &FitReport) -> String {
    let width = width(report.parameters.iter().map(|it| it.key.as_str()));
    let mut lines = vec![format!("{:width$}  {:>12}  95 % interval", "parameter", "estimate")];
    for it in &report.parameters {
        let [low, high] = it.interval.map(number);
        let remark = match (it.at_bound, it.is_determined) {
            (Some(_), _) => "  at its bound",
            (None, false) => "  not determined: the whole range",
            (None, true) => "",
        };
        lines.push(format!("{:width$}  {:>12}  {low} to {high}{remark}", it.key, number(it.value)));
    }
    lines.extend(report.undetermined.iter().map(|line| format!("not determined: {line}")));
    lines.extend(report.cautions.iter().map(|line| format!("caution: {line}")));
    lines.push(format!(
        "{} residuals, reduced chi-square {:.3}; {} steps, {} evaluations, {:.1} s simulated",
        report.residual_count,
        report.reduced_chi_square,
        report.iterations,
        report.evaluations,
        report.simulated_s
    ));
    for experiment in &report.experiments {
        lines.push(format!("{} ({})", experiment.name, experiment.role.replace('_', " ")));
        let columns =
            experiment.measured.iter().flat_map(|it| it.columns.iter().map(move |column| (it, column)));
        lines.extend(columns.map(|(measured, column)| column_line(measured, column)));
    }
    lines.join("\n")
}

fn column_line(measured: &MeasuredReport, column: &ColumnReport) -> String {
    let unit = &measured.unit;
    let estimated = if column.noise_is_estimated { " (estimated)" } else { "" };
    let error = column.rms.map_or(String::new(), |rms| {
        format!("error {} {unit} rms, noise {}{estimated}, ", number(rms), number(column.noise))
    });
    let sampled =
        column.band.sampled.map_or(String::new(), |sampled| format!(" ({} by sampling)", number(sampled)));
    let model = match column.band.model {
        0.0 => String::new(),
        model => format!(" and {} for the model", number(model)),
    };
    let coverage = column
        .band
        .coverage
        .map_or(String::new(), |share| format!(", {:.1} % of the rows in the band", 100.0 * share));
    format!(
        "  {} {}: {error}band ±{} {unit}{sampled}{model}{coverage}",
        measured.name,
        column.name,
        number(column.band.linear)
    )
}

/// Formats a check.
pub fn check_text(report: &CheckReport) -> String {
    let mut lines = vec![format!(
        "{} parameters, {} residuals; mean square at the start {}",
        report.parameters,
        report.residual_count,
        number(report.mean_square)
    )];
    lines.extend(report.start.iter().map(|(key, value)| format!("  {key} starts at {}", number(*value))));
    for experiment in &report.experiments {
        lines.push(format!(
            "{} ({}), {} s simulated",
            experiment.name,
            experiment.role.replace('_', " "),
            number(experiment.simulated_s)
        ));
        for measured in &experiment.measured {
            let rows = measured.rows;
            lines.push(format!(
                "  {}: {} rows, {} outside the simulated time, {} without a time, {} missing values, {} gaps",
                measured.name, rows.rows, rows.outside, rows.without_time, rows.missing_values, rows.gaps
            ));
            for column in &measured.columns {
                let rms = number(column.rms.unwrap_or(0.0));
                let noise = match column.noise_is_estimated {
                    true => "noise to be estimated".to_owned(),
                    false => format!("noise {}", number(column.noise)),
                };
                lines.push(format!("    {}: first error {rms} {} rms, {noise}", column.name, measured.unit));
            }
        }
    }
    lines.extend(report.notes.iter().map(|note| format!("note: {note}")));
    lines.join("\n")
}

/// Formats a ranking of candidates.
pub fn design_text(report: &DesignReport) -> String {
    let keys = report.parameters.iter().map(String::as_str).chain(["parameter"]);
    let width = width(keys);
    let mut lines = vec![format!("{:width$}  {:>12}  {:>12}", "parameter", "value", "95 % ±")];
    let rows = report.parameters.iter().zip(&report.values).zip(&report.half_widths);
    for ((key, value), half) in rows {
        lines.push(format!("{key:width$}  {:>12}  {:>12}", number(*value), number(*half)));
    }
    for (place, candidate) in report.candidates.iter().enumerate() {
        lines.push(format!(
            "{}. {}: the confidence region shrinks to {} of its volume",
            place + 1,
            candidate.name,
            number(candidate.volume)
        ));
        for (key, half) in report.parameters.iter().zip(&candidate.half_widths) {
            lines.push(format!("{key:width$}  {:>12}  {:>12}", "", number(*half)));
        }
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::number;

    #[test]
    fn numbers_have_five_significant_digits() {
        let given = [1.234_567, 0.000_123_456_7, 123_456.7, 0.0, -2.5, 1e-12, 1e9];
        let said = ["1.2346", "0.00012346", "123457", "0", "-2.5000", "1.0000e-12", "1.0000e9"];
        assert_eq!(given.map(number), said);
    }
}
