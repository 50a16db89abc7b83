//! How floats lie in a stream: on a grid, as octahedral coordinates, or as they are.

use draco_core::normal_compression_utils::OctahedronToolBox;
use draco_core::quantization_utils::{Dequantizer, Quantizer};
use draco_core::{DataType, GeometryAttributeType, PointAttribute};

/// Bits that Draco can quantise with.
const BITS: std::ops::RangeInclusive<u8> = 1..=30;
/// Bits that encoders give normals.
const USUAL_BITS: [u8; 5] = [10, 8, 9, 11, 12];
/// Finest grid on which floats between 0 and 1 are exact, in bits.
const FINEST: i32 = 24;

/// How an attribute lies in a stream.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::asset) enum Quantization {
    /// Without loss: integers, or floats as they are.
    Lossless,
    /// On a grid.
    Grid(Grid),
    /// Unit vectors on an octahedron, with so many bits.
    Octahedral(u8),
}

/// A grid of values, alike along every component.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::asset) struct Grid {
    /// The least value of each component.
    pub(in crate::asset) origin: Vec<f32>,
    /// From the first value to the last.
    pub(in crate::asset) range: f32,
    /// There are two to the power of it values.
    pub(in crate::asset) bits: u8,
}

impl Grid {
    fn greatest(&self) -> i32 {
        ((1u64 << self.bits) - 1) as i32
    }

    /// From one value to the next.
    pub(in crate::asset) fn step(&self) -> f64 {
        f64::from(self.range) / f64::from(self.greatest())
    }

    /// What readers make of a component, with the arithmetic of Draco.
    pub(super) fn delivered(&self, component: usize, value: f32) -> f32 {
        let origin = self.origin.get(component).copied().unwrap_or_default();
        let (mut to, mut from) = (Quantizer::new(), Dequantizer::new());
        to.init(self.range, self.greatest());
        from.init(self.range, self.greatest());
        from.dequantize_float(to.quantize_float(value - origin)) + origin
    }

    /// A grid of whole multiples of a power of two that holds values from `low` to `high`: each of them that is such a multiple comes back
    /// exactly. None where 30 bits are too few.
    pub(in crate::asset) fn dyadic(low: &[f32], high: &[f32], exponent: i32) -> Option<Self> {
        let step = 2f64.powi(exponent);
        let origin: Vec<f64> = low.iter().map(|v| (f64::from(*v) / step).floor() * step).collect();
        let steps = origin.iter().zip(high).map(|(o, h)| ((f64::from(*h) - o) / step).ceil()).fold(1.0, f64::max);
        let bits = BITS.into_iter().find(|bits| 2f64.powi(i32::from(*bits)) - 1.0 >= steps)?;
        // A number of more than 24 bits is no float.
        if i32::from(bits) > FINEST || origin.iter().any(|o| f64::from(*o as f32) != *o) {
            return None;
        }
        let range = (2f64.powi(i32::from(bits)) - 1.0) * step;
        Some(Grid { origin: origin.iter().map(|o| *o as f32).collect(), range: range as f32, bits })
    }

    /// The grid, or where values lie outside of it one of equal steps that holds them.
    pub(in crate::asset) fn holding(&self, low: &[f32], high: &[f32]) -> Option<Self> {
        let end = |o: f32| f64::from(o) + f64::from(self.range) + 0.25 * self.step();
        let is_inside = self.origin.iter().zip(low).all(|(o, l)| f64::from(*l) >= f64::from(*o) - 0.25 * self.step())
            && self.origin.iter().zip(high).all(|(o, h)| f64::from(*h) <= end(*o));
        if is_inside {
            return Some(self.clone());
        }
        let extent = low.iter().zip(high).map(|(l, h)| f64::from(*h) - f64::from(*l)).fold(0.0, f64::max);
        let bits = BITS.into_iter().find(|b| (2f64.powi(i32::from(*b)) - 1.0) * self.step() >= extent)?;
        let range = ((2f64.powi(i32::from(bits)) - 1.0) * self.step()) as f32;
        Some(Grid { origin: low.to_vec(), range, bits })
    }
}

/// The power of two of which all values are multiples, where it is at least 2^-24 and at most 1.
pub(in crate::asset) fn common_exponent(values: impl Iterator<Item = f32>) -> Option<i32> {
    let mut found = 0;
    for value in values {
        let mut scaled = f64::from(value) * 2f64.powi(-found);
        while scaled.fract() != 0.0 {
            found -= 1;
            scaled *= 2.0;
            if found < -FINEST {
                return None;
            }
        }
        if !value.is_finite() {
            return None;
        }
    }
    Some(found)
}

/// How a decoded attribute lay in its stream.
///
/// The decoder does not tell, but the parameters stand in the stream: those are they with which every value comes out of the grid again, bit for bit.
pub(super) fn quantization(attribute: &PointAttribute, stream: &[u8]) -> Quantization {
    let components = usize::from(attribute.num_components());
    if attribute.data_type() != DataType::Float32 || components == 0 {
        return Quantization::Lossless;
    }
    let (values, _) = attribute.buffer().data().as_chunks::<4>();
    let values: Vec<f32> = values.iter().map(|b| f32::from_le_bytes(*b)).collect();
    if values.is_empty() || values.iter().any(|v| !v.is_finite()) {
        return Quantization::Lossless;
    }
    if attribute.attribute_type() == GeometryAttributeType::Normal && components == 3 {
        return octahedral(&values).map_or(Quantization::Lossless, Quantization::Octahedral);
    }
    grid(&values, components, stream).map_or(Quantization::Lossless, Quantization::Grid)
}

/// The bits with which vectors come out as they are, the usual ones first: few vectors go with many. One in a hundred may round to a neighbour,
/// as those do that lie where the octahedron was folded.
fn octahedral(values: &[f32]) -> Option<u8> {
    let (vectors, _) = values.as_chunks::<3>();
    USUAL_BITS.into_iter().chain(2..=30).find(|bits| {
        let mut tools = OctahedronToolBox::new();
        let mut wrong = 0;
        tools.set_quantization_bits(i32::from(*bits))
            && vectors.iter().all(|v| {
                wrong += usize::from(unit(&tools, v) != *v);
                wrong <= vectors.len() / 100
            })
    })
}

fn unit(tools: &OctahedronToolBox, vector: &[f32; 3]) -> [f32; 3] {
    let (s, t) = tools.float_vector_to_quantized_octahedral_coords(vector);
    tools.quantized_octahedral_coords_to_unit_vector(s, t)
}

/// What readers make of a vector that is quantised with so many bits.
pub(super) fn delivered_vector(bits: u8, vector: [f32; 3]) -> [f32; 3] {
    let mut tools = OctahedronToolBox::new();
    tools.set_quantization_bits(i32::from(bits));
    unit(&tools, &vector)
}

/// Looks through a stream for an origin, a range and a number of bits that give the values.
fn grid(values: &[f32], components: usize, stream: &[u8]) -> Option<Grid> {
    let (low, high) = bounds(values, components);
    let extent = low.iter().zip(&high).map(|(l, h)| h - l).fold(0.0, f32::max);
    let size = 4 * components + 5;
    // Of what only looks like parameters few values are tried; a stream may hold as much of it as it likes.
    let mut left = 16 * values.len() + (1 << 20);
    stream.windows(size).find_map(|window| {
        let (floats, bits) = window.split_at(size - 1);
        let bits = *bits.first()?;
        let (floats, _) = floats.as_chunks::<4>();
        let range = floats.last().map(|b| f32::from_le_bytes(*b))?;
        if !(BITS.contains(&bits) && range.is_finite() && range > 0.0 && range >= 0.99 * extent) {
            return None;
        }
        let origin: Vec<f32> = floats.iter().take(components).map(|b| f32::from_le_bytes(*b)).collect();
        // A NaN is not below anything.
        let slack = 1e-5 * range;
        if !origin.iter().zip(&low).all(|(o, l)| *o <= *l + slack)
            || !origin.iter().zip(&high).all(|(o, h)| *h <= *o + range * 1.001)
        {
            return None;
        }
        let found = Grid { origin, range, bits };
        let is_on = |(n, value): (usize, &f32)| found.delivered(n % components, *value) == *value;
        let is_all = values.iter().enumerate().all(|of| {
            left = left.saturating_sub(1);
            left > 0 && is_on(of)
        });
        is_all.then_some(found)
    })
}

/// Least and greatest value of each component.
pub(in crate::asset) fn bounds(values: &[f32], components: usize) -> (Vec<f32>, Vec<f32>) {
    let (mut low, mut high) = (vec![f32::INFINITY; components], vec![f32::NEG_INFINITY; components]);
    for element in values.chunks_exact(components) {
        for (k, value) in element.iter().enumerate() {
            low[k] = low[k].min(*value);
            high[k] = high[k].max(*value);
        }
    }
    (low, high)
}
