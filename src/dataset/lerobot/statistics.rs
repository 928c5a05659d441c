//! Statistics of a feature, with the names and the way of combining of LeRobot 0.4 (`compute_stats.py`):
//! minimum, maximum, mean, standard deviation, number of rows and five quantiles.

use serde_json::{Value, json};

/// Names of the quantiles, and their shares.
const QUANTILES: [(&str, f64); 5] = [("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)];

/// Statistics of the elements of a feature over the rows of an episode or of all episodes.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    elements: Vec<Element>,
    rows: u64,
    /// Whether the feature is a picture: one element, written as three channels of shape (3, 1, 1).
    is_picture: bool,
}

#[derive(Debug, Clone, PartialEq)]
struct Element {
    min: f64,
    max: f64,
    mean: f64,
    variance: f64,
    quantiles: [f64; QUANTILES.len()],
}

impl Statistics {
    /// Computes the statistics of a feature with `width` elements from its rows, one after another. Quantiles
    /// are interpolated between neighbours, as `numpy.quantile` does.
    pub fn of_rows(width: usize, values: &[f32]) -> Statistics {
        let width = width.max(1);
        let element = |index: usize| {
            let column = values.iter().skip(index).step_by(width);
            let mut sorted: Vec<f64> = column.map(|value| f64::from(*value)).collect();
            sorted.sort_unstable_by(f64::total_cmp);
            Element::of_sorted(&sorted)
        };
        let rows = (values.len() / width) as u64;
        Statistics { elements: (0..width).map(element).collect(), rows, is_picture: false }
    }

    /// Computes the statistics of `rows` pictures from how many of their pixels have each grey; 255 is 1.
    pub fn of_pictures(rows: u64, pixels: &[u64; 256]) -> Statistics {
        let total = pixels.iter().sum::<u64>().max(1);
        let greys = || pixels.iter().enumerate().map(|(grey, count)| (grey as f64 / 255.0, *count));
        let sum = |of: &dyn Fn(f64) -> f64| greys().map(|(grey, count)| of(grey) * count as f64).sum::<f64>();
        let mean = sum(&|grey| grey) / total as f64;
        let place = |index: u64| {
            let mut before = 0;
            let found = greys().find(|(_, count)| {
                before += count;
                before > index
            });
            found.map_or(0.0, |(grey, _)| grey)
        };
        let element = Element {
            min: place(0),
            max: place(total - 1),
            mean,
            variance: sum(&|grey| (grey - mean).powi(2)) / total as f64,
            quantiles: QUANTILES
                .map(|(_, share)| between(share, total as usize, |index| place(index as u64))),
        };
        Statistics { elements: vec![element], rows, is_picture: true }
    }

    /// Combines the statistics of several episodes of one feature. Quantiles are the means of the episodes'
    /// quantiles, weighted by their rows, as LeRobot combines them.
    pub fn combined(parts: &[&Statistics]) -> Option<Statistics> {
        let first = parts.first()?;
        let rows = parts.iter().map(|part| part.rows).sum::<u64>();
        let element = |index: usize| {
            let each = || parts.iter().filter_map(|part| Some((part.elements.get(index)?, part.rows as f64)));
            let mean_of = |of: &dyn Fn(&Element) -> f64| {
                each().map(|(element, weight)| of(element) * weight).sum::<f64>() / rows.max(1) as f64
            };
            let mean = mean_of(&|element| element.mean);
            Element {
                min: each().fold(f64::INFINITY, |least, (element, _)| least.min(element.min)),
                max: each().fold(f64::NEG_INFINITY, |most, (element, _)| most.max(element.max)),
                mean,
                variance: mean_of(&|element| element.variance + (element.mean - mean).powi(2)),
                quantiles: std::array::from_fn(|at| mean_of(&|element| element.quantiles[at])),
            }
        };
        let elements = (0..first.elements.len()).map(element).collect();
        Some(Statistics { elements, rows, is_picture: first.is_picture })
    }

    /// Returns each statistic by name; pictures have their three equal channels.
    pub fn named(&self) -> Vec<(&'static str, Vec<f64>)> {
        let repeated = if self.is_picture { 3 } else { 1 };
        let column = |of: &dyn Fn(&Element) -> f64| {
            let values: Vec<f64> = self.elements.iter().map(of).collect();
            values.repeat(repeated)
        };
        let mut named = vec![
            ("min", column(&|element| element.min)),
            ("max", column(&|element| element.max)),
            ("mean", column(&|element| element.mean)),
            ("std", column(&|element| element.variance.max(0.0).sqrt())),
            ("count", vec![self.rows as f64]),
        ];
        let quantile = |(at, (name, _)): (usize, &(&'static str, f64))| {
            (*name, column(&|element| element.quantiles[at]))
        };
        named.extend(QUANTILES.iter().enumerate().map(quantile));
        named
    }

    /// Returns the entry of `stats.json`.
    pub fn json(&self) -> Value {
        let entry = |(name, values): (&'static str, Vec<f64>)| {
            let value = match (name, self.is_picture) {
                ("count", _) => json!([self.rows]),
                (_, true) => values.iter().map(|value| json!([[value]])).collect(),
                (_, false) => json!(values),
            };
            (name.to_owned(), value)
        };
        self.named().into_iter().map(entry).collect()
    }
}

impl Element {
    fn of_sorted(sorted: &[f64]) -> Element {
        let count = sorted.len().max(1) as f64;
        let mean = sorted.iter().sum::<f64>() / count;
        let at = |index: usize| sorted.get(index).copied().unwrap_or(0.0);
        Element {
            min: at(0),
            max: at(sorted.len().saturating_sub(1)),
            mean,
            variance: sorted.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count,
            quantiles: QUANTILES.map(|(_, share)| between(share, sorted.len(), at)),
        }
    }
}

/// Interpolates the quantile of this share between neighbours of `count` sorted values.
fn between(share: f64, count: usize, at: impl Fn(usize) -> f64) -> f64 {
    let place = share * count.saturating_sub(1) as f64;
    let low = at(place.floor() as usize);
    low + (at(place.ceil() as usize) - low) * place.fract()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(statistics: &Statistics, name: &str) -> Vec<f64> {
        statistics.named().into_iter().find(|(other, _)| *other == name).unwrap().1
    }

    /// By `numpy.quantile([4, 1, 3, 2], q)`, `numpy.mean` and `numpy.std`.
    #[test]
    fn a_column_has_the_statistics_of_numpy() {
        let statistics = Statistics::of_rows(2, &[4.0, 7.0, 1.0, 7.0, 3.0, 7.0, 2.0, 7.0]);
        for (name, first) in
            [("min", 1.0), ("max", 4.0), ("mean", 2.5), ("q10", 1.3), ("q50", 2.5), ("q99", 3.97)]
        {
            let found = value(&statistics, name);
            assert!((found[0] - first).abs() < 1e-12 && found[1] == 7.0, "{name}: {found:?}");
        }
        let std = value(&statistics, "std");
        assert!((std[0] - 1.25_f64.sqrt()).abs() < 1e-12 && std[1] == 0.0, "{std:?}");
        assert_eq!(value(&statistics, "count"), [4.0]);
    }

    #[test]
    fn episodes_combine_to_the_statistics_of_all_their_rows() {
        let (all, first, second) = ([1.0, 2.0, 3.0, 10.0, 20.0], [1.0, 2.0, 3.0], [10.0, 20.0]);
        let parts = [Statistics::of_rows(1, &first), Statistics::of_rows(1, &second)];
        let combined = Statistics::combined(&[&parts[0], &parts[1]]).unwrap();
        let whole = Statistics::of_rows(1, &all);
        for name in ["min", "max", "mean", "std", "count"] {
            let (found, expected) = (value(&combined, name)[0], value(&whole, name)[0]);
            assert!((found - expected).abs() < 1e-12, "{name}: {found}, expected {expected}");
        }
        // The weighted mean of the medians 2 and 15.
        assert!((value(&combined, "q50")[0] - 7.2).abs() < 1e-12);
    }

    #[test]
    fn pictures_have_the_statistics_of_their_pixels() {
        let greys = [0_u8, 51, 51, 255];
        let mut pixels = [0; 256];
        greys.iter().for_each(|grey| pixels[usize::from(*grey)] += 1);
        let of_pixels = Statistics::of_rows(1, &greys.map(|grey| f32::from(grey) / 255.0));
        let of_pictures = Statistics::of_pictures(2, &pixels);
        for name in ["min", "max", "mean", "std", "q01", "q50", "q90"] {
            let (found, expected) = (value(&of_pictures, name), value(&of_pixels, name)[0]);
            assert_eq!(found.len(), 3, "{name}");
            // The pixels of `of_pixels` were rounded to single precision.
            assert!(
                found.iter().all(|value| (value - expected).abs() < 1e-7),
                "{name}: {found:?} {expected}"
            );
        }
        assert_eq!(of_pictures.json()["count"], json!([2]));
        assert_eq!(of_pictures.json()["max"], json!([[[1.0]], [[1.0]], [[1.0]]]));
    }
}
