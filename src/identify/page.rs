//! The page of an identification: one self-contained HTML file.

use std::path::Path;

use askama::Template;
use data_encoding::BASE64;
use figures::{Figure, FigureError};
use sim::identification::{FitReport, Series};

use super::figure;
use super::text::{fit_text, number};
use crate::failure::Failure;

struct Picture {
    caption: String,
    data_uri: String,
}

#[derive(Template)]
#[template(path = "identification.html")]
struct Page<'a> {
    title: String,
    version: &'static str,
    report: &'a FitReport,
    /// Key, estimate, standard deviation, interval and remark of each parameter.
    rows: Vec<[String; 5]>,
    /// Key and correlations of each parameter.
    correlation: Vec<(String, Vec<String>)>,
    table: String,
    intervals: Picture,
    pictures: Vec<Picture>,
}

fn picture(caption: String, figure: Result<Figure, FigureError>) -> Result<Picture, Failure> {
    let svg = figure.and_then(|figure| figure.svg(Path::new("figure.svg"))).map_err(Failure::failed)?;
    Ok(Picture { caption, data_uri: format!("data:image/svg+xml;base64,{}", BASE64.encode(svg.as_bytes())) })
}

/// Renders the page.
///
/// # Errors
/// A figure or the page cannot be drawn.
pub fn html(name: &str, report: &FitReport) -> Result<String, Failure> {
    let row = |(index, it): (usize, &sim::identification::ParameterReport)| {
        let [low, high] = it.interval.map(number);
        let remark = match (it.at_bound, it.is_determined) {
            (Some(_), _) => "at its bound",
            (None, false) => "not determined",
            (None, true) => "",
        };
        [
            format!("{} {}", index + 1, it.key),
            number(it.value),
            it.sd.map_or_else(|| "-".to_owned(), number),
            format!("{low} to {high}"),
            remark.to_owned(),
        ]
    };
    let correlation = report.parameters.iter().zip(&report.correlation).map(|(it, row)| {
        (it.key.clone(), row.iter().map(|value| format!("{value:.2}")).collect())
    });
    let mut pictures = Vec::new();
    for experiment in &report.experiments {
        let series: Vec<&Series> = report.series.iter().filter(|it| it.experiment == experiment.name).collect();
        let caption = format!("{} ({})", experiment.name, experiment.role.replace('_', " "));
        pictures.push(picture(caption, figure::experiment(&experiment.name, &series))?);
    }
    let page = Page {
        title: format!("Identification: {name}"),
        version: env!("CARGO_PKG_VERSION"),
        report,
        rows: report.parameters.iter().enumerate().map(row).collect(),
        correlation: correlation.collect(),
        table: fit_text(report),
        intervals: picture("Estimates and 95 % intervals".to_owned(), figure::intervals(report))?,
        pictures,
    };
    page.render().map_err(Failure::failed)
}
