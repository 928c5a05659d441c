//! A photon energy spectrum through tissue, bone and metal.
//!
//! Every voxel is a mixture of tissue (water's attenuation, scaled by density) and ICRU-44 cortical bone. A
//! ray is therefore described by two lengths: tissue T and bone B, in metres of water and of cortical bone;
//! the tool adds lengths of metal. The detector integrates energy:
//!
//! `attenuation(T, B) = -ln( sum_E w_E exp(-(T mu_water(E) + B mu_bone(E))) )`, `w_E ~ E N(E)`
//!
//! with N(E) after Kramers (Philos. Mag. 46 (1923) 836), `V/E - 1`, filtered by aluminium. Coefficients: NIST
//! ([`Material`]). The model neglects characteristic lines, and energies below 30 keV, which hardly penetrate
//! a patient. Anatomy pixels look up a table of the attenuation over (T, B); the few pixels under metal, and
//! those outside the table, sum over the energies.

use scene::Spectrum;
use smallvec::SmallVec;

use crate::attenuation::{ALUMINIUM_G_PER_CM3, ENERGY_RANGE_KEV, Material, cortical_bone_hu};
use crate::error::{DrrError, check_range};
use crate::tool_layer::{ToolCell, ToolMaterials};

/// Energy spacing of the sum.
const STEP_KEV: f64 = 2.0;
/// Range and number of nodes of the table.
const TISSUE_MAX_M: f64 = 0.5;
const BONE_MAX_M: f64 = 0.16;
const TISSUE_NODES: usize = 257;
const BONE_NODES: usize = 257;

/// Checks every field.
fn validate(spectrum: &Spectrum) -> Result<(), DrrError> {
    check_range("tube_kv", spectrum.tube_kv, 50.0, 120.0, "50 to 120 kV")?;
    check_range("aluminium_mm", spectrum.aluminium_mm, 0.0, 20.0, "0 to 20 mm")?;
    let (low, high) = ENERGY_RANGE_KEV;
    check_range("ct_energy_kev", spectrum.ct_energy_kev, low, high, "30 to 120 keV")?;
    check_range("bone_above_hu", spectrum.bone_above_hu, 0.0, 1000.0, "0 to 1000 HU")
}

/// Energies, keV, and the fraction of the open-field signal that each contributes.
pub fn weights(spectrum: &Spectrum) -> Vec<(f64, f64)> {
    let lowest = ENERGY_RANGE_KEV.0;
    let count = ((spectrum.tube_kv - lowest) / STEP_KEV).max(1.0) as usize;
    let step = (spectrum.tube_kv - lowest) / count as f64;
    let mut weights: Vec<(f64, f64)> = (0..count)
        .map(|i| {
            let energy = lowest + (i as f64 + 0.5) * step;
            let filter_cm = 0.1 * spectrum.aluminium_mm;
            let mu = ALUMINIUM_G_PER_CM3 * Material::Aluminium.mass_mu_cm2_per_g(energy);
            (energy, energy * (spectrum.tube_kv / energy - 1.0) * libm::exp(-mu * filter_cm))
        })
        .collect();
    let total: f64 = weights.iter().map(|(_, w)| w).sum();
    weights.iter_mut().for_each(|(_, w)| *w /= total);
    weights
}

/// Fractions of tissue (relative to water) and of cortical bone in a voxel.
fn mixture(spectrum: &Spectrum) -> Result<Mixture, DrrError> {
    Ok(Mixture {
        bone_above_hu: spectrum.bone_above_hu,
        cortical_hu: cortical_bone_hu(spectrum.ct_energy_kev)?.max(spectrum.bone_above_hu + 1.0),
    })
}

/// Tissue and bone of a Hounsfield value: tissue of density 1 + HU/1000 up to `bone_above_hu`, then a mixture
/// of that densest tissue and cortical bone, pure bone at `cortical_hu`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mixture {
    /// HU above which a voxel contains bone.
    pub bone_above_hu: f64,
    /// HU of cortical bone in the CT.
    pub cortical_hu: f64,
}

impl Mixture {
    /// (tissue relative to water, fraction of cortical bone); for enamel and metal in the CT the bone
    /// fraction exceeds 1.
    pub fn of(&self, hu: f64) -> (f64, f64) {
        if hu <= self.bone_above_hu {
            return ((1.0 + hu / 1000.0).max(0.0), 0.0);
        }
        let bone = (hu - self.bone_above_hu) / (self.cortical_hu - self.bone_above_hu);
        ((1.0 - bone).max(0.0) * (1.0 + self.bone_above_hu / 1000.0), bone)
    }
}

/// Coefficients at one energy.
#[derive(Debug, Clone, Copy)]
struct Line {
    weight: f64,
    water: f64,
    bone: f64,
    /// Indexed by [`Material::index`].
    materials: [f64; Material::COUNT],
}

/// The attenuation of a spectrum, tabulated over tissue and bone.
#[derive(Debug, Clone)]
pub struct SpectrumTable {
    lines: Vec<Line>,
    /// Attenuation over bone, then tissue, in steps of the constants above.
    nodes: Vec<f32>,
    mixture: Mixture,
}

impl SpectrumTable {
    /// Computes the table.
    ///
    /// # Errors
    /// A field is out of range; the error names the first one.
    pub fn new(spectrum: &Spectrum) -> Result<Self, DrrError> {
        validate(spectrum)?;
        let mut lines = Vec::new();
        for (energy, weight) in weights(spectrum) {
            let mut materials = [0.0; Material::COUNT];
            for material in Material::ALL {
                materials[material.index()] = material.mu_per_m(energy)?;
            }
            let (water, bone) = (Material::Water.mu_per_m(energy)?, Material::CorticalBone.mu_per_m(energy)?);
            lines.push(Line { weight, water, bone, materials });
        }
        let mut table = Self { lines, nodes: Vec::new(), mixture: mixture(spectrum)? };
        let mut nodes = Vec::with_capacity(TISSUE_NODES * BONE_NODES);
        for t in 0..TISSUE_NODES {
            for b in 0..BONE_NODES {
                let tissue = t as f64 * TISSUE_MAX_M / (TISSUE_NODES - 1) as f64;
                let bone = b as f64 * BONE_MAX_M / (BONE_NODES - 1) as f64;
                nodes.push(table.exact(tissue, bone, &[0.0; Material::COUNT]) as f32);
            }
        }
        table.nodes = nodes;
        Ok(table)
    }

    /// Conversion of Hounsfield units to tissue and bone.
    pub fn mixture(&self) -> Mixture {
        self.mixture
    }

    /// The sum over energies, for metres of tissue, of bone and, by [`Material::index`], of other materials.
    pub fn exact(&self, tissue_m: f64, bone_m: f64, materials_m: &[f64; Material::COUNT]) -> f64 {
        let there = materials_m.iter().enumerate().filter(|(_, length_m)| **length_m != 0.0);
        let there: SmallVec<[(usize, f64); 4]> = there.map(|(index, length_m)| (index, *length_m)).collect();
        let mut sum = 0.0;
        for line in &self.lines {
            let mut depth = tissue_m * line.water + bone_m * line.bone;
            for (index, length_m) in &there {
                depth += length_m * line.materials[*index];
            }
            sum += line.weight * crate::lane_math::exp(-depth);
        }
        -crate::lane_math::log(sum)
    }

    /// The attenuation of tissue and bone, from the table.
    #[inline(always)]
    pub fn attenuation(&self, tissue_m: f64, bone_m: f64) -> f64 {
        let t = tissue_m.max(0.0) * ((TISSUE_NODES - 1) as f64 / TISSUE_MAX_M);
        let b = bone_m.max(0.0) * ((BONE_NODES - 1) as f64 / BONE_MAX_M);
        let (it, ib) = (t as usize, b as usize);
        if it >= TISSUE_NODES - 1 || ib >= BONE_NODES - 1 {
            return self.exact(tissue_m.max(0.0), bone_m.max(0.0), &[0.0; Material::COUNT]);
        }
        let node = |i: usize, j: usize| f64::from(self.nodes[i * BONE_NODES + j]);
        let (ft, fb) = (t - it as f64, b - ib as f64);
        let near = node(it, ib) + fb * (node(it, ib + 1) - node(it, ib));
        let far = node(it + 1, ib) + fb * (node(it + 1, ib + 1) - node(it + 1, ib));
        near + ft * (far - near)
    }

    /// Replaces the metres of tissue in a row by the attenuation of tissue and bone.
    #[inline(always)]
    pub(crate) fn attenuation_of_row(&self, tissue_m: &mut [f64], bone_m: &[f64]) {
        for (value, &bone) in tissue_m.iter_mut().zip(bone_m) {
            *value = self.attenuation(*value, bone);
        }
    }

    /// The attenuation of a pixel under the tool.
    pub(crate) fn attenuation_with_tool(
        &self,
        tissue_m: f64,
        bone_m: f64,
        cell: &ToolCell,
        materials: &ToolMaterials,
    ) -> f64 {
        let tissue_m = (tissue_m - cell.displaced).max(0.0);
        let bone_m = (bone_m - materials.displaced_bone_m).max(0.0);
        self.exact(tissue_m, bone_m, &materials.lengths_m)
    }
}
