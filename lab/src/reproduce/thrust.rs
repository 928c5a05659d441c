//! Thrust and torque of twist drills: published measurements against the law of the twist drill, its
//! simulation, and the law of the burr.
//!
//! Rows are measurements whose primary source was read, at least its abstract. The constants of the twist
//! drill's law are fitted to every second row and judged on the others: by level, within 30 %, and by the
//! exponents of thrust and torque in speed, feed, diameter and density, by sign and within a factor of 1.5.
//! The sources differ by a factor of 10 in the same bone, so the fit minimizes the sum of absolute logarithms
//! (a median), not of squares (a mean between the sources, which none of them supports).

use core::f64::consts::{PI, TAU};

use crate::effort::Effort;
use rayon::prelude::*;
use simulation::bone::twist_drill::{DrillPoint, TwistDrillLaw};
use simulation::bone::{CuttingLaw, MaterialLaw};

use super::output::{Plan, Table};
use super::rig::{Block, Trial};
use trabecula::failure::Failure;

/// Density at which the constants hold, kg/m³.
const DENSITY_REF: f64 = 1900.0;
/// Largest deviation of a level.
const LEVEL: f64 = 0.3;
/// Largest ratio of two exponents.
const SLOPE: f64 = 1.5;

/// Geometry of a general-purpose twist drill; no source states its own. The chisel edge is a fifth of the
/// diameter.
const POINT_DEG: f64 = 118.0;
const CHISEL: f64 = 0.2;

/// A measurement.
#[derive(Clone, Copy)]
struct Row {
    bone: &'static str,
    source: &'static str,
    /// No source gives it: 1900 kg/m³ for cortical bone, 2000 for bovine, 1640 for the short-fibre epoxy of
    /// composite femurs.
    density_kg_per_m3: f64,
    diameter_mm: f64,
    feed_mm_per_s: f64,
    rpm: f64,
    thrust_n: f64,
    torque_nmm: Option<f64>,
    /// Which of feed and speed the source does not state where it was read.
    assumed: &'static str,
}

/// MacAvelia et al. 2012, Biomechanical measurements of surgical drilling force and torque in human versus
/// artificial femurs, J. Biomech. Eng. 134:124503 (abstract): 3.2 mm, 120 mm/min.
const MACAVELIA: &str = "MacAvelia et al. 2012 J. Biomech. Eng. 134:124503 (abstract)";
/// Orelaja et al. 2020, J. Healthcare Eng. 8817422 (abstract): 2.5 mm, means of the largest forces. The
/// percentages of the abstract contradict its forces: 20.07 to 12.34 N is a drop of 38.5 %, not 23.85.
const ORELAJA: &str = "Orelaja et al. 2020 J. Healthcare Eng. 8817422 (abstract)";
/// Testing and research of drilling feed force on fresh porcine femur, J. Med. Biomech. 2014, no. 6
/// (abstract): 5.0 mm, lowest and highest of nine settings.
const PORCINE: &str = "J. Med. Biomech. 2014(6) drilling feed force on fresh porcine femur (abstract)";
/// Experimental and finite element investigation of high speed bone drilling, doi 10.1007/s40430-020-02436-w.
const HIGH_SPEED: &str = "J. Braz. Soc. Mech. Sci. Eng. 2020 42:349 (abstract)";

const fn macavelia(bone: &'static str, density: f64, rpm: f64, thrust_n: f64, torque_nmm: f64) -> Row {
    Row {
        bone,
        source: MACAVELIA,
        density_kg_per_m3: density,
        diameter_mm: 3.2,
        feed_mm_per_s: 2.0,
        rpm,
        thrust_n,
        torque_nmm: Some(torque_nmm),
        assumed: "",
    }
}

const fn orelaja(bone: &'static str, density: f64, rpm: f64, thrust_n: f64, torque_nmm: f64) -> Row {
    Row {
        source: ORELAJA,
        diameter_mm: 2.5,
        feed_mm_per_s: 50.0 / 60.0,
        assumed: "feed",
        ..macavelia(bone, density, rpm, thrust_n, torque_nmm)
    }
}

const fn porcine(feed_mm_per_min: f64, rpm: f64, thrust_n: f64) -> Row {
    Row {
        bone: "porcine",
        source: PORCINE,
        density_kg_per_m3: 1900.0,
        diameter_mm: 5.0,
        feed_mm_per_s: feed_mm_per_min / 60.0,
        rpm,
        thrust_n,
        torque_nmm: None,
        assumed: "",
    }
}

/// Every second row, from the first, is used for the fit.
const ROWS: [Row; 15] = [
    macavelia("human", 1900.0, 1000.0, 198.4, 186.3),
    macavelia("human", 1900.0, 1250.0, 180.6, 157.8),
    macavelia("human", 1900.0, 1500.0, 176.3, 140.2),
    macavelia("composite", 1640.0, 1000.0, 87.2, 67.2),
    macavelia("composite", 1640.0, 1250.0, 82.2, 61.0),
    macavelia("composite", 1640.0, 1500.0, 75.7, 53.3),
    orelaja("bovine", 2000.0, 1000.0, 20.07, 41.2),
    orelaja("bovine", 2000.0, 1500.0, 12.34, 24.2),
    orelaja("porcine", 1900.0, 1000.0, 11.25, 37.0),
    orelaja("porcine", 1900.0, 1500.0, 8.14, 21.6),
    orelaja("artificial", 1640.0, 1000.0, 5.62, 13.6),
    orelaja("artificial", 1640.0, 1500.0, 3.86, 6.7),
    porcine(30.0, 1200.0, 106.04),
    porcine(70.0, 500.0, 139.84),
    Row {
        bone: "cortical",
        source: HIGH_SPEED,
        density_kg_per_m3: 2000.0,
        diameter_mm: 2.0,
        torque_nmm: None,
        assumed: "",
        ..orelaja("cortical", 2000.0, 12_000.0, 14.11, 0.0)
    },
];

impl Row {
    fn is_fitted(index: usize) -> bool {
        index.is_multiple_of(2)
    }

    fn feed_per_revolution_m(&self) -> f64 {
        self.feed_mm_per_s * 1e-3 * 60.0 / self.rpm
    }

    fn point(&self) -> DrillPoint {
        let radius_m = self.diameter_mm * 0.5e-3;
        DrillPoint {
            radius_m,
            chisel_radius_m: CHISEL * radius_m,
            point_deg: POINT_DEG,
            rake_deg: DrillPoint::STANDARD_RAKE_DEG,
        }
    }

    /// Returns thrust in N and torque in N mm by the law of the twist drill.
    fn by(&self, law: &TwistDrillLaw) -> [f64; 2] {
        let ratio = self.density_kg_per_m3 / DENSITY_REF;
        let [thrust_n, torque_nm] = law.load(&self.point(), self.feed_per_revolution_m(), ratio);
        [thrust_n, torque_nm * 1e3]
    }

    /// Returns thrust in N and torque in N mm by the default law of scenes, that of the burr: `u A f / (2 pi
    /// mu 2R/3)` for a disc.
    fn by_burr(&self) -> [f64; 2] {
        let (material, mu) = (MaterialLaw::default(), CuttingLaw::default().cutting_friction);
        let radius_m = self.diameter_mm * 0.5e-3;
        let ratio = self.density_kg_per_m3 / DENSITY_REF;
        let energy_j_per_m3 = material.specific_energy_ref_j_m3 * ratio.powf(material.exponent);
        let lever_m = radius_m * 2.0 / 3.0;
        let area_m2 = PI * radius_m * radius_m;
        let thrust_n = energy_j_per_m3 * area_m2 * self.feed_per_revolution_m() / (TAU * mu * lever_m);
        [thrust_n, mu * thrust_n * lever_m * 1e3]
    }

    fn measured(&self) -> [Option<f64>; 2] {
        [Some(self.thrust_n), self.torque_nmm]
    }

    /// Returns the sum of the absolute logarithms of law over measurement.
    fn miss(&self, law: &TwistDrillLaw) -> f64 {
        let own = self.by(law);
        let pairs = own.iter().zip(self.measured());
        pairs.map(|(own, measured)| measured.map_or(0.0, |measured| (own / measured).ln().abs())).sum()
    }
}

/// Fits the three constants to every second row on a grid, refined around its best point.
fn fitted() -> TwistDrillLaw {
    let rows: Vec<&Row> =
        ROWS.iter().enumerate().filter(|(index, _)| Row::is_fitted(*index)).map(|(_, row)| row).collect();
    let miss = |law: &TwistDrillLaw| rows.iter().map(|row| row.miss(law)).sum::<f64>();
    let mut best = TwistDrillLaw { edge_n_per_m: 4e3, energy_j_per_m3: 0.5e9, chisel_pressure: 1.0 };
    // Factors of 12 on both sides, then ever closer.
    for span in [12.0_f64, 2.0, 1.2, 1.05, 1.01] {
        let steps = |middle: f64| (-20_i32..=20).map(move |k| middle * span.powf(f64::from(k) / 20.0));
        let laws = steps(best.edge_n_per_m).flat_map(|edge_n_per_m| {
            steps(best.energy_j_per_m3).flat_map(move |energy_j_per_m3| {
                steps(best.chisel_pressure).map(move |chisel_pressure| TwistDrillLaw {
                    edge_n_per_m,
                    energy_j_per_m3,
                    chisel_pressure,
                })
            })
        });
        best = laws.min_by(|a, b| miss(a).total_cmp(&miss(b))).unwrap_or(best);
    }
    best
}

/// A measured trend: two settings and the ratio of what was measured at the second to that at the first.
struct Trend {
    what: &'static str,
    /// 0 thrust, 1 torque.
    load: usize,
    from: Row,
    to: Row,
    /// Ratio of the varied quantity.
    varied: f64,
    measured: f64,
}

impl Trend {
    /// Compares two rows.
    fn of(what: &'static str, load: usize, [from, to]: [usize; 2], varied: fn(&Row) -> f64) -> Trend {
        let (from, to) = (ROWS[from], ROWS[to]);
        let (varied, value) = (varied(&to) / varied(&from), |row: &Row| row.measured()[load]);
        let measured = value(&to).zip(value(&from)).map_or(f64::NAN, |(to, from)| to / from);
        Trend { what, load, from, to, varied, measured }
    }

    /// Returns the exponent of a ratio of loads in the varied quantity.
    fn exponent(&self, ratio: f64) -> f64 {
        ratio.ln() / self.varied.ln()
    }
}

/// Drilling parameters of bovine cortex, Arch. Bone Jt. Surg., abjs.mums.ac.ir/article_16047 (abstract): 2.5
/// and 3.2 mm, 0.5 to 3 mm/s; the speed is not stated there. The thrust "decreased by almost 230 %" from 2.5
/// to 3.2 mm is read as a factor of 3.3, and "increased by 335 %" as one of 4.35.
fn abjs(diameter_mm: f64, feed_mm_per_s: f64) -> Row {
    Row { diameter_mm, feed_mm_per_s, torque_nmm: None, ..macavelia("bovine", 2000.0, 1000.0, 0.0, 0.0) }
}

fn trends() -> [Trend; 13] {
    let speed = |row: &Row| row.rpm;
    let per_turn = |row: &Row| row.feed_per_revolution_m();
    let density = |row: &Row| row.density_kg_per_m3;
    [
        Trend::of("speed: human (MacAvelia)", 0, [0, 2], speed),
        Trend::of("speed: human (MacAvelia)", 1, [0, 2], speed),
        Trend::of("speed: composite (MacAvelia)", 0, [3, 5], speed),
        Trend::of("speed: composite (MacAvelia)", 1, [3, 5], speed),
        Trend::of("speed: bovine (Orelaja)", 0, [6, 7], speed),
        Trend::of("speed: bovine (Orelaja)", 1, [6, 7], speed),
        Trend::of("speed: porcine (Orelaja)", 0, [8, 9], speed),
        Trend::of("speed: porcine (Orelaja)", 1, [8, 9], speed),
        Trend::of("feed per revolution: porcine", 0, [12, 13], per_turn),
        Trend {
            what: "feed: bovine (Arch. Bone Jt. Surg.)",
            load: 0,
            from: abjs(3.2, 0.5),
            to: abjs(3.2, 3.0),
            varied: 6.0,
            measured: 4.35,
        },
        Trend {
            what: "diameter: bovine (Arch. Bone Jt. Surg.)",
            load: 0,
            from: abjs(2.5, 0.5),
            to: abjs(3.2, 0.5),
            varied: 3.2 / 2.5,
            measured: 1.0 / 3.3,
        },
        Trend::of("density: composite to human (MacAvelia)", 0, [3, 0], density),
        Trend::of("density: composite to human (MacAvelia)", 1, [3, 0], density),
    ]
}

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    let law = fitted();
    let simulated: Vec<f64> =
        ROWS.par_iter().map(|row| simulated_n(row, plan.effort)).collect::<Result<_, Failure>>()?;
    let mut table = Table::new(&[
        "bone",
        "mm",
        "mm_per_s",
        "rpm",
        "assumed",
        "half",
        "thrust_n",
        "law_n",
        "ratio",
        "within",
        "torque_nmm",
        "law_nmm",
        "torque_ratio",
        "torque_within",
        "simulated_n",
        "burr_law_n",
        "source",
    ]);
    let yes = |within: bool| if within { "yes" } else { "no" }.to_owned();
    let within = |ratio: f64| (1.0 - LEVEL..=1.0 + LEVEL).contains(&ratio);
    let mut counts = [[0, 0]; 2];
    for ((index, row), simulated_n) in ROWS.iter().enumerate().zip(simulated) {
        let own = row.by(&law);
        let [thrust, torque] = [0, 1].map(|load| row.measured()[load].map(|measured| own[load] / measured));
        for ratio in [thrust, torque].into_iter().flatten() {
            let half = &mut counts[usize::from(!Row::is_fitted(index))];
            half[0] += usize::from(within(ratio));
            half[1] += 1;
        }
        let shown = |value: Option<f64>, digits: usize| {
            value.map_or_else(String::new, |value| format!("{value:.digits$}"))
        };
        table.row(vec![
            row.bone.to_owned(),
            format!("{}", row.diameter_mm),
            format!("{:.2}", row.feed_mm_per_s),
            format!("{}", row.rpm),
            row.assumed.to_owned(),
            if Row::is_fitted(index) { "fitted" } else { "judged" }.to_owned(),
            format!("{}", row.thrust_n),
            format!("{:.1}", own[0]),
            shown(thrust, 2),
            thrust.map_or_else(String::new, |ratio| yes(within(ratio))),
            row.torque_nmm.map_or_else(String::new, |torque| format!("{torque}")),
            row.torque_nmm.map_or_else(String::new, |_| format!("{:.1}", own[1])),
            shown(torque, 2),
            torque.map_or_else(String::new, |ratio| yes(within(ratio))),
            format!("{simulated_n:.1}"),
            format!("{:.1}", row.by_burr()[0]),
            row.source.to_owned(),
        ]);
    }
    table.finish(&plan.out, "reproduce-5-thrust.csv")?;
    say!(
        "\ntwist drill: edges {:.2} N/mm, energy {:.3} J/mm3, chisel edge {:.2} times that; level within {:.0} \
         %: {} of {} fitted, {} of {} judged values\n",
        law.edge_n_per_m * 1e-3,
        law.energy_j_per_m3 * 1e-9,
        law.chisel_pressure,
        LEVEL * 100.0,
        counts[0][0],
        counts[0][1],
        counts[1][0],
        counts[1][1]
    );
    slopes(plan, &law)
}

/// Prints exponents: measured, of the law, and of the burr's law.
fn slopes(plan: &Plan, law: &TwistDrillLaw) -> Result<(), Failure> {
    let mut table = Table::new(&[
        "trend",
        "of",
        "measured",
        "law",
        "sign",
        "within",
        "burr_law",
        "burr_sign",
        "burr_within",
    ]);
    let mut counts = [[0, 0]; 2];
    let trends = trends();
    for trend in &trends {
        let measured = trend.exponent(trend.measured);
        let own = trend.exponent(trend.to.by(law)[trend.load] / trend.from.by(law)[trend.load]);
        let burr = trend.exponent(trend.to.by_burr()[trend.load] / trend.from.by_burr()[trend.load]);
        let judged = [own, burr].map(|exponent| {
            let ratio = exponent / measured;
            [ratio > 0.0, (1.0 / SLOPE..=SLOPE).contains(&ratio)]
        });
        for (count, judged) in counts.iter_mut().zip(judged) {
            count[0] += usize::from(judged[0]);
            count[1] += usize::from(judged[1]);
        }
        let yes = |within: bool| if within { "yes" } else { "no" }.to_owned();
        table.row(vec![
            trend.what.to_owned(),
            if trend.load == 0 { "thrust" } else { "torque" }.to_owned(),
            format!("{measured:.2}"),
            format!("{own:.2}"),
            yes(judged[0][0]),
            yes(judged[0][1]),
            format!("{burr:.2}"),
            yes(judged[1][0]),
            yes(judged[1][1]),
        ]);
    }
    table.finish(&plan.out, "reproduce-5-slopes.csv")?;
    let [[own_sign, own], [burr_sign, burr]] = counts;
    say!(
        "\nexponents of {} trends: twist drill {own_sign} signs, {own} within a factor of {SLOPE}; burr \
         {burr_sign} and {burr}",
        trends.len()
    );
    Ok(())
}

/// Returns the mean thrust of the simulated drill at a steady feed, N: a stiff bit, 1 mm above the bone at
/// first.
fn simulated_n(row: &Row, effort: Effort) -> Result<f64, Failure> {
    let voxel_mm = if effort == Effort::Quick { 0.5 } else { 0.25 };
    let block = Block::new([-4.0, -4.0, 1.0], [4.0, 4.0, 10.0], voxel_mm, |_| row.density_kg_per_m3);
    let diameter_mm = row.diameter_mm;
    let tool = format!(
        "name = \"drill\"\n[tube]\nouter_diameter_mm = {:?}\ninner_diameter_mm = 0.0\n\
         linear_density_kg_per_m = 0.05\nyoungs_modulus_gpa = 200.0\n[[flexure]]\nat_mm = 40.0\ncount = 2\n\
         pitch_mm = 5.0\n[burr]\nshape = \"bit\"\ndiameter_mm = {diameter_mm:?}\nlength_mm = 9.0\n\
         tip_diameter_mm = {:?}\npoint_deg = {POINT_DEG:?}\nscallop_mm = 0.1\noffset_mm = 12.0\n\
         mass_g = 1.0\n",
        diameter_mm * 0.9,
        diameter_mm * CHISEL
    );
    let trial = Trial {
        dt_ms: 2.0,
        stiffness: 100.0,
        burr_rpm: row.rpm,
        tool: Some(tool),
        law: Some("twist_drill"),
        pilot: false,
        ..Trial::new(0.0, row.feed_mm_per_s, 7.0)
    };
    trial.play(&block, |_, _| {}).map(|outcome| outcome.mean_force_n)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The constants that scenes use are those of this fit.
    #[test]
    fn the_shipped_constants_are_the_fitted_ones() {
        let (fit, own) = (fitted(), TwistDrillLaw::default());
        for (fit, own) in [
            (fit.edge_n_per_m, own.edge_n_per_m),
            (fit.energy_j_per_m3, own.energy_j_per_m3),
            (fit.chisel_pressure, own.chisel_pressure),
        ] {
            assert!((fit / own - 1.0).abs() < 0.01, "fitted {fit}, shipped {own}");
        }
    }

    /// A simulated drill needs the thrust of the closed form: human femur at 1000 rpm.
    #[test]
    fn a_simulated_drill_needs_the_thrust_of_the_law() -> Result<(), Failure> {
        let row = &ROWS[0];
        let [law_n, _] = row.by(&TwistDrillLaw::default());
        let simulated_n = simulated_n(row, Effort::Quick)?;
        assert!((simulated_n / law_n - 1.0).abs() < 0.15, "{simulated_n} {law_n}");
        Ok(())
    }
}
