//! The exposure's loops over pixels, each for one chunk or row.

use counter_random::Key;
use scene::Display;

use crate::detector::{Readout, add_scaled_row, blur_row};
use crate::display::Scale;
use crate::exposure::CHUNK;
use crate::lane_math;
use crate::lanes::lanes;
use crate::spectrum::SpectrumTable;

lanes! {
    /// Computes the grey levels of a chunk of a row.
    ToGreys { scale: Scale, values: &'a [f64; CHUNK], out: &'a mut [u16] } -> () {
        scale.to_greys(values, out);
    }
}

lanes! {
    /// Blurs a row along itself.
    BlurRow { line: &'a [f32], weights: &'a [f32], out: &'a mut [f32] } -> () {
        blur_row(line, weights, out);
    }
}

lanes! {
    /// Computes the fraction of photons transmitted or scattered.
    Transmit { values: &'a [f64; CHUNK], scattered: &'a [f64; CHUNK], out: &'a mut [f32] } -> () {
        for (o, (v, s)) in out.iter_mut().zip(values.iter().zip(scattered)) {
            *o = (lane_math::exp(-v) + s) as f32;
        }
    }
}

lanes! {
    /// Computes the fraction of photons detected, with noise. `values` become mean photon counts; returns the
    /// smallest.
    Detect {
        photons: f64,
        key: Key,
        first_pixel: u64,
        scattered: &'a [f64; CHUNK],
        values: &'a mut [f64; CHUNK],
        out: &'a mut [f32],
    } -> f64 {
        for (v, s) in values.iter_mut().zip(scattered) {
            *v = photons * (lane_math::exp(-*v) + s);
        }
        for (i, (o, mean)) in out.iter_mut().zip(values.iter()).enumerate() {
            let normal = lane_math::normal(key.word(first_pixel + i as u64));
            *o = (lane_math::round(mean + mean.sqrt() * normal).max(0.0) / photons) as f32;
        }
        let mut least = [f64::INFINITY; 8];
        for some in values.chunks_exact(8) {
            for (l, v) in least.iter_mut().zip(some) {
                *l = l.min(*v);
            }
        }
        least.into_iter().fold(f64::INFINITY, f64::min)
    }
}

lanes! {
    /// Looks up the attenuation of tissue and bone.
    Tabulate { table: &'a SpectrumTable, tissue_m: &'a mut [f64], bone_m: &'a [f64] } -> () {
        table.attenuation_of_row(tissue_m, bone_m);
    }
}

lanes! {
    /// Applies the readout to attenuations, without noise or blur.
    ReadThrough {
        readout: Readout,
        mode: Display,
        scattered: &'a [f64; CHUNK],
        values: &'a mut [f64; CHUNK],
    } -> () {
        for (v, s) in values.iter_mut().zip(scattered) {
            *v = readout.apply(lane_math::exp(-*v) + s);
        }
        if mode != Display::Linear {
            to_attenuation(values);
        }
    }
}

lanes! {
    /// [`column_blur`].
    BlurColumns {
        source: &'a [f32],
        weights: &'a [f32],
        width: usize,
        row: usize,
        from: usize,
        out: &'a mut [f32],
    } -> () {
        column_blur(source, width, row, from, weights, out);
    }
}

lanes! {
    /// Applies the readout to fractions of photons.
    ReadOut {
        readout: Readout,
        mode: Display,
        detected: &'a [f32; CHUNK],
        values: &'a mut [f64; CHUNK],
    } -> () {
        for (v, s) in values.iter_mut().zip(detected) {
            *v = readout.apply(f64::from(*s));
        }
        if mode != Display::Linear {
            to_attenuation(values);
        }
    }
}

/// Blurs the pixels `from..` of a row along the columns, with edge rows repeated outside the image.
#[inline(always)]
pub(crate) fn column_blur(
    image: &[f32],
    width: usize,
    row: usize,
    from: usize,
    weights: &[f32],
    out: &mut [f32],
) {
    let (reach, last) = (weights.len() / 2, image.len() / width - 1);
    for (i, w) in weights.iter().enumerate() {
        let start = (row + i).saturating_sub(reach).min(last) * width + from;
        add_scaled_row(out, *w, &image[start..]);
    }
}

/// -ln of the readout. The readout is clamped to half a photon in 1e6, so that no signal is black rather than
/// infinite.
#[inline(always)]
fn to_attenuation(values: &mut [f64; CHUNK]) {
    for v in values.iter_mut() {
        *v = -lane_math::log(v.max(5e-7));
    }
}
