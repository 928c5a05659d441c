//! `drr.svg`: error against milliseconds, both logarithmic.

use plotters::backend::SVGBackend;
use plotters::chart::{ChartBuilder, SeriesLabelPosition};
use plotters::coord::combinators::IntoLogRange;
use plotters::drawing::IntoDrawingArea;
use plotters::element::{Circle, PathElement, TriangleMarker};
use plotters::prelude::Palette;
use plotters::series::LineSeries;
use plotters::style::{BLACK, Color, FontStyle, Palette99, WHITE, register_font};

use super::Point;
use trabecula::failure::Failure;

/// Draws the points of two threads (triangles: peers); the line is the time to read the finest volume once.
pub fn draw(points: &[Point], stream_ms: f64) -> Result<String, Failure> {
    let mut text = String::new();
    draw_into(&mut text, points, stream_ms)
        .map_err(|cause| Failure::failed(format!("drr.svg: cannot be drawn ({cause})")))?;
    Ok(text)
}

fn draw_into(text: &mut String, points: &[Point], stream_ms: f64) -> Result<(), Box<dyn std::error::Error>> {
    register_font("sans-serif", FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT)
        .map_err(|_| "the built-in font is not one")?;
    let shown: Vec<&Point> = points.iter().filter(|p| p.threads == 2).collect();
    let range = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, 0.0_f64), |(low, high), v| (low.min(v), high.max(v)))
    };
    let times = shown.iter().map(|p| p.least_and_median_ms().0).chain([stream_ms]);
    let (fast, slow) = range(&mut times.filter(|v| *v > 0.0));
    let (good, bad) = range(&mut shown.iter().map(|p| p.exact.rms).filter(|v| *v > 0.0));
    let (left, right, bottom, top) = (fast / 1.5, slow * 1.5, good / 1.5, bad * 1.5);
    let area = SVGBackend::with_string(text, (820, 520)).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(14)
        .x_label_area_size(44)
        .y_label_area_size(70)
        .build_cartesian_2d((left..right).log_scale(), (bottom..top).log_scale())?;
    chart
        .configure_mesh()
        .x_desc("ms a frame, 2 threads (least)")
        .y_desc("relative r.m.s. error against the closed line integrals")
        .y_label_formatter(&|v| format!("{v:.0e}"))
        .label_style(("sans-serif", 14))
        .draw()?;
    let limit = [(stream_ms, bottom), (stream_ms, top)];
    chart
        .draw_series(LineSeries::new(limit, BLACK.stroke_width(1)))?
        .label("reading the volume once")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 14, y)], BLACK));
    let mut methods: Vec<&str> = shown.iter().map(|p| p.method.as_str()).collect();
    methods.sort_unstable();
    methods.dedup();
    for (number, method) in methods.iter().enumerate() {
        let colour = Palette99::pick(number).filled();
        let of_method =
            shown.iter().filter(|p| p.method == *method).map(|p| (p.least_and_median_ms().0, p.exact.rms));
        let series = if method.starts_with("peer:") {
            chart.draw_series(of_method.map(|at| TriangleMarker::new(at, 6, colour)))?
        } else {
            chart.draw_series(of_method.map(|at| Circle::new(at, 4, colour)))?
        };
        series.label(*method).legend(move |(x, y)| Circle::new((x + 7, y), 4, colour));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .label_font(("sans-serif", 14))
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK)
        .draw()?;
    area.present()?;
    Ok(())
}
