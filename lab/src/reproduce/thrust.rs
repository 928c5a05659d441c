//! Thrust of drills and burrs in closed form, and of the simulated burr, compared with published ranges.
//!
//! A cutter of radius r that advances by v in bone of density rho needs `F = E (rho/1900)^a + K (rho/1900)^b
//! A v / (w r_eff)`, where A is the cross-section of its hole. The first term is the ploughing of the edges,
//! the second the cutting (K is specific energy over cutting coefficient). The edges plough in proportion to
//! the hole's area, `E = p0 A`, or to its diameter, `E = e D`, since edges have a length. A drill is a disc,
//! whose mean lever by area is 2r/3; the end of a ball has the same lever, and its hole is wider by the
//! reach.

use core::f64::consts::{PI, TAU};

use crate::effort::Effort;
use rayon::prelude::*;
use simulation::bone::{CuttingLaw, MaterialLaw};

use super::output::{Plan, Table};
use super::rig::{Block, Trial};
use trabecula::failure::Failure;

/// Density at which the constants hold, kg/m³.
const DENSITY_REF: f64 = 1900.0;
/// 50 mm/min, the feed of the drilling at 12 000 rpm; also used if a source does not state its feed.
const FEED_MM_PER_S: f64 = 50.0 / 60.0;

#[derive(Clone, Copy, PartialEq)]
enum Tool {
    /// Diameter, mm.
    Drill(f64),
    /// The standard burr.
    Ball,
}

struct Row {
    what: &'static str,
    source: &'static str,
    density_kg_per_m3: f64,
    tool: Tool,
    feed_mm_per_s: f64,
    /// Lowest and highest speed; the law must be in range at both.
    rpm: [f64; 2],
    /// Which of density, tool, feed and speed are not from the source.
    assumed: &'static str,
    range_n: [f64; 2],
    /// Whether the range was measured by a source.
    measured: bool,
    /// Whether the constants are fitted on the row.
    fit: bool,
}

/// Orelaja et al. 2020: their own measurements at two speeds, whose means are the ends of the range.
const ORELAJA: &str = "Orelaja et al. 2020 J. Healthcare Eng. 8817422 (abstract and table 6)";
/// Their table 6 quotes thrusts of others, without tool, feed and speed.
const QUOTED: &str = "quoted in table 6 of Orelaja et al. 2020 J. Healthcare Eng. 8817422";
const MACAVELIA: &str = "MacAvelia et al. 2012 J. Biomech. Eng. 134:124503 (abstract)";
const HIGH_SPEED: &str = "J. Braz. Soc. Mech. Sci. Eng. 2020 42:349 (abstract)";

const fn foam(what: &'static str, density: f64, feed: f64, fit: bool) -> Row {
    Row {
        what,
        source: "none: the few newtons with which such foam is drilled by hand",
        density_kg_per_m3: density,
        tool: Tool::Ball,
        feed_mm_per_s: feed,
        rpm: [2250.0; 2],
        assumed: "range",
        range_n: [1.0, 5.0],
        measured: false,
        fit,
    }
}

const fn orelaja(what: &'static str, density: f64, range_n: [f64; 2], fit: bool) -> Row {
    Row {
        what,
        source: ORELAJA,
        density_kg_per_m3: density,
        tool: Tool::Drill(2.5),
        feed_mm_per_s: FEED_MM_PER_S,
        rpm: [1000.0, 1500.0],
        assumed: "density feed",
        range_n,
        measured: true,
        fit,
    }
}

/// A drill of 2.5 mm in cancellous bone, and of 3.2 mm, that of a 4.5 mm screw, in shafts, at 1000 rpm.
const fn quoted(what: &'static str, density: f64, diameter_mm: f64, range_n: [f64; 2], fit: bool) -> Row {
    Row {
        source: QUOTED,
        tool: Tool::Drill(diameter_mm),
        rpm: [1000.0; 2],
        assumed: "density tool feed speed",
        ..orelaja(what, density, range_n, fit)
    }
}

/// Three speeds; the largest force is at the lowest speed. Table 6 of Orelaja et al. prints the torques of
/// this source, 53.3 to 186.3 N mm, as forces.
const fn macavelia(what: &'static str, density: f64, range_n: [f64; 2]) -> Row {
    Row {
        source: MACAVELIA,
        tool: Tool::Drill(3.2),
        feed_mm_per_s: 2.0,
        assumed: "density",
        ..orelaja(what, density, range_n, false)
    }
}

/// Every second of the first nine rows is used for the fit. The tools of the four rows after them are
/// unknown.
const ROWS: [Row; 15] = [
    foam("foam 10 PCF 0.05 mm/s", 160.0, 0.05, false),
    foam("foam 10 PCF 0.15 mm/s", 160.0, 0.15, true),
    foam("foam 20 PCF 0.15 mm/s", 320.0, 0.15, false),
    quoted("human trochanter cancellous (Tsai)", 350.0, 2.5, [1.0, 1.5], true),
    quoted("porcine vertebra (Powers)", 600.0, 2.5, [0.6, 29.6], false),
    orelaja("artificial femur", 640.0, [3.86, 5.62], true),
    orelaja("porcine femur", 1700.0, [8.14, 11.25], false),
    orelaja("bovine femur", 2000.0, [12.34, 20.07], true),
    Row {
        source: HIGH_SPEED,
        tool: Tool::Drill(2.0),
        rpm: [12_000.0; 2],
        // 14.11 N, plus or minus a fifth.
        assumed: "density range",
        ..orelaja("cortical bone 12 000 rpm", 2000.0, [11.3, 16.9], false)
    },
    quoted("human trochanter cortical (Tsai)", 1900.0, 3.2, [0.0, 50.0], false),
    quoted("bovine femoral shaft (Alam)", 2000.0, 3.2, [25.0, 85.0], false),
    quoted("bovine tibial shaft (Hillery)", 2000.0, 3.2, [24.0, 48.0], false),
    quoted("bovine tibial shaft (Lee)", 2000.0, 3.2, [0.0, 20.0], false),
    macavelia("human femur (MacAvelia)", 1900.0, [176.3, 198.4]),
    macavelia("composite femur (MacAvelia)", 1640.0, [75.7, 87.2]),
];
/// Number of rows before those of shafts.
const FIRST: usize = 9;

/// Quantity that the edge force is proportional to.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Edge {
    /// The hole's cross-section.
    Area,
    /// The hole's diameter.
    Length,
}

/// Constants of the law.
#[derive(Debug, Clone, Copy)]
struct Law {
    by: Edge,
    /// p0, MPa, or e, N/mm.
    edge: f64,
    /// a.
    edge_exponent: f64,
    /// K, MPa.
    cut_mpa: f64,
    /// b.
    cut_exponent: f64,
}

impl Law {
    /// Returns the default law of scenes.
    fn standard() -> Law {
        let law = MaterialLaw::default();
        Law {
            by: Edge::Area,
            edge: law.edge_pressure_ref_pa * 1e-6,
            edge_exponent: law.edge_exponent,
            cut_mpa: law.specific_energy_ref_j_m3 / CuttingLaw::default().cutting_friction * 1e-6,
            cut_exponent: law.exponent,
        }
    }

    /// Returns the thrust in closed form, N.
    fn thrust_n(&self, row: &Row, rpm: f64) -> f64 {
        let reach_mm = CuttingLaw::default().reach_m * 1e3;
        let (radius_mm, hole_mm) = match row.tool {
            Tool::Drill(diameter_mm) => (0.5 * diameter_mm, 0.5 * diameter_mm),
            Tool::Ball => (3.25, 3.25 + reach_mm),
        };
        let area_mm2 = PI * hole_mm * hole_mm;
        let ratio = row.density_kg_per_m3 / DENSITY_REF;
        let speed_mm_per_s = rpm * TAU / 60.0 * radius_mm * 2.0 / 3.0;
        let extent = match self.by {
            Edge::Area => area_mm2,
            Edge::Length => 2.0 * hole_mm,
        };
        let edge_n = self.edge * ratio.powf(self.edge_exponent) * extent;
        let cut_mpa = self.cut_mpa * ratio.powf(self.cut_exponent);
        edge_n + cut_mpa * row.feed_mm_per_s / speed_mm_per_s * area_mm2
    }

    fn is_inside(&self, row: &Row) -> bool {
        row.rpm.iter().all(|rpm| (row.range_n[0]..=row.range_n[1]).contains(&self.thrust_n(row, *rpm)))
    }

    /// Returns the sum over the speeds of the squared logarithm of the deviation from the range.
    fn miss(&self, row: &Row) -> f64 {
        let outside = |rpm: &f64| {
            let thrust_n = self.thrust_n(row, *rpm);
            let nearest_n = thrust_n.clamp(row.range_n[0].max(0.01), row.range_n[1]);
            (thrust_n / nearest_n).ln().powi(2)
        };
        row.rpm.iter().map(outside).sum()
    }

    /// Fits the constants on a grid: those that bring most rows into range, and of those the ones with the
    /// smallest deviation of the other rows.
    fn fitted_on(rows: &[&Row], by: Edge) -> Law {
        let steps = |low: f64, high: f64, count: i32| {
            (0..=count).map(move |k| low * (high / low).powf(f64::from(k) / f64::from(count)))
        };
        let (low, high) = match by {
            Edge::Area => (0.5, 8.0),
            Edge::Length => (1.0, 16.0),
        };
        let laws = steps(low, high, 60).flat_map(|edge| {
            (10..=24).flat_map(move |a| {
                steps(5.0, 500.0, 60).flat_map(move |cut_mpa| {
                    (0..=20).map(move |b| Law {
                        by,
                        edge,
                        edge_exponent: f64::from(a) * 0.1,
                        cut_mpa,
                        cut_exponent: f64::from(b) * 0.1,
                    })
                })
            })
        });
        let score = |law: &Law| {
            let inside = rows.iter().filter(|row| law.is_inside(row)).count();
            (inside, rows.iter().map(|row| law.miss(row)).sum::<f64>())
        };
        let better = |a: &(usize, f64), b: &(usize, f64)| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1));
        let scored = laws.map(|law| (score(&law), law));
        scored.max_by(|(a, _), (b, _)| better(a, b)).map_or_else(Law::standard, |(_, law)| law)
    }
}

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    let half: Vec<&Row> = ROWS.iter().filter(|row| row.fit).collect();
    let first: Vec<&Row> = ROWS.iter().take(FIRST).collect();
    let laws = [
        Law::standard(),
        Law::fitted_on(&half, Edge::Area),
        Law::fitted_on(&first, Edge::Area),
        Law::fitted_on(&half, Edge::Length),
    ];
    let [standard, area, _, length] = &laws;
    let simulated: Vec<Option<f64>> = ROWS
        .par_iter()
        .map(|row| match row.tool {
            Tool::Ball => simulated_n(row, length, plan.effort).map(Some),
            Tool::Drill(_) => Ok(None),
        })
        .collect::<Result<_, Failure>>()?;
    let mut table = Table::new(&[
        "what",
        "tool",
        "rpm",
        "feed_mm_per_s",
        "density_kg_per_m3",
        "assumed",
        "range_n",
        "range_is",
        "standard_n",
        "standard_inside",
        "half",
        "by_area_n",
        "by_area_inside",
        "by_length_n",
        "by_length_inside",
        "simulated_n",
        "source",
    ]);
    let span = |[low, high]: [f64; 2]| if low == high { format!("{low}") } else { format!("{low}-{high}") };
    let yes = |inside: bool| if inside { "yes" } else { "no" }.to_owned();
    for (row, simulated) in ROWS.iter().zip(simulated) {
        let at = |law: &Law| {
            let [slow, fast] = row.rpm.map(|rpm| law.thrust_n(row, rpm));
            if slow == fast { format!("{slow:.3}") } else { format!("{fast:.3}-{slow:.3}") }
        };
        let tool = match row.tool {
            Tool::Drill(diameter_mm) => format!("drill {diameter_mm} mm"),
            Tool::Ball => "ball 6.5 mm".to_owned(),
        };
        table.row(vec![
            row.what.to_owned(),
            tool,
            span(row.rpm),
            format!("{:.2}", row.feed_mm_per_s),
            format!("{}", row.density_kg_per_m3),
            row.assumed.to_owned(),
            span(row.range_n),
            if row.measured { "published" } else { "assumption" }.to_owned(),
            at(standard),
            yes(standard.is_inside(row)),
            if row.fit { "fitted" } else { "checked" }.to_owned(),
            at(area),
            yes(area.is_inside(row)),
            at(length),
            yes(length.is_inside(row)),
            simulated.map_or_else(String::new, |thrust_n| format!("{thrust_n:.3}")),
            row.source.to_owned(),
        ]);
    }
    table.finish(&plan.out, "reproduce-5-thrust.csv")?;
    let count = |law: &Law, rows: &dyn Fn(usize, &Row) -> bool| {
        let chosen: Vec<&Row> =
            (0..).zip(&ROWS).filter(|(place, row)| rows(*place, row)).map(|(_, row)| row).collect();
        format!("{} of {}", chosen.iter().filter(|row| law.is_inside(row)).count(), chosen.len())
    };
    let names = ["standard", "by area, half", "by area, all nine", "by length, half"];
    for (name, law) in names.iter().zip(&laws) {
        let Law { by, edge, edge_exponent, cut_mpa, cut_exponent } = law;
        let edge = match by {
            Edge::Area => format!("p0 {edge:.2} MPa"),
            Edge::Length => format!("e {edge:.2} N/mm"),
        };
        say!("{name}: {edge}, a {edge_exponent:.1}, K {cut_mpa:.1} MPa, b {cut_exponent:.1}");
        say!(
            "    inside: {} of the half fitted on, {} of the other rows, {} measured, {} of the first nine, \
             {} in all",
            count(law, &|_, row| row.fit),
            count(law, &|_, row| !row.fit),
            count(law, &|_, row| row.measured),
            count(law, &|place, _| place < FIRST),
            count(law, &|_, _| true),
        );
    }
    Ok(())
}

/// Returns the mean thrust of the simulated burr at a steady feed, N.
fn simulated_n(row: &Row, law: &Law, effort: Effort) -> Result<f64, Failure> {
    let block = Block::new([-6.0, -6.0, -12.0], [6.0, 6.0, 12.0], 0.5, |_| row.density_kg_per_m3);
    let insertion_mm = if effort == Effort::Quick { 1.0 } else { 5.0 };
    let energy_j_per_mm3 = law.cut_mpa * 1e-3 * CuttingLaw::default().cutting_friction;
    let trial = Trial {
        dt_ms: 2.0,
        stiffness: 1000.0,
        burr_rpm: row.rpm[0],
        cutting_law: Some([energy_j_per_mm3, law.cut_exponent]),
        edge_law: Some([law.edge, law.edge_exponent]),
        ..Trial::new(0.0, row.feed_mm_per_s, insertion_mm)
    };
    trial.play(&block, |_, _| {}).map(|outcome| outcome.mean_force_n)
}
