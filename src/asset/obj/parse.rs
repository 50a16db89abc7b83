//! The geometry of an OBJ file: vertices, faces and which material each face has.

use super::lines::{Lines, keyword, words};
use super::number::{float, integer};
use super::quote_bytes;
use crate::asset::limits::Limits;
use crate::asset::name::from_bytes;
use crate::asset::precision::{NEAR, is_far};
use crate::error::{Code, Failure, Result};

/// No texture coordinate, no normal, no material.
pub(crate) const NONE: u32 = u32::MAX;

/// Most materials of one file: each becomes a primitive, which takes some kilobytes however few faces it has.
const MOST_MATERIALS: usize = 100_000;

/// A corner of a face: indices from 0 of its position, texture coordinate and normal.
pub(crate) type Corner = [u32; 3];

/// What an OBJ file says.
#[derive(Debug, Default)]
pub(crate) struct ObjGeometry {
    /// `v`, relative to the origin
    pub(crate) positions: Vec<[f32; 3]>,
    /// Colour of each position; empty where no vertex has one, white where only this one has none.
    pub(crate) colors: Vec<[f32; 3]>,
    /// `vt`
    pub(crate) uvs: Vec<[f32; 2]>,
    /// `vn`; zero where it has no direction
    pub(crate) normals: Vec<[f32; 3]>,
    /// Corners of all faces.
    pub(crate) corners: Vec<Corner>,
    /// Faces in order.
    pub(crate) faces: Vec<Face>,
    /// `mtllib` lines in order, as they are written.
    pub(crate) libraries: Vec<String>,
    /// Names of `usemtl` in order of first use.
    pub(crate) materials: Vec<String>,
    /// First `o` name.
    pub(crate) name: Option<String>,
    /// Faces of fewer than three corners that were left out, and the line of the first.
    pub(crate) thin: Option<(usize, usize)>,
    /// Lines, points, curves and surfaces that were left out.
    pub(crate) others: usize,
    /// What positions are relative to, where 32 bits could not tell them apart far from the origin.
    pub(crate) origin: Option<[f64; 3]>,
    /// The line of the first face that names a texture coordinate, where the file has none.
    pub(crate) lacks_uvs: Option<u32>,
    /// Faces that were left out because a position of theirs is not finite, and the line of the first.
    pub(crate) without_position: Option<(usize, usize)>,
    /// Faces that have no texture coordinates because one of theirs is not finite, and the line of the first.
    pub(crate) without_uv: Option<(usize, usize)>,
}

/// A polygon.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Face {
    /// First of its corners.
    pub(crate) start: u32,
    /// Number of its corners, at least 3.
    pub(crate) count: u32,
    /// Index into `materials`, or [`NONE`].
    pub(crate) material: u32,
    /// Line in the file.
    pub(crate) line: u32,
}

impl ObjGeometry {
    /// The corners of a face.
    pub(crate) fn corners_of(&self, face: &Face) -> &[Corner] {
        let start = face.start as usize;
        self.corners.get(start..start + face.count as usize).unwrap_or_default()
    }
}

/// Reads an OBJ file.
///
/// # Errors
/// `invalid_model` with the line number: a number that is none, an index that is out of range;
/// `too_large` beyond the limit on triangles.
pub(crate) fn parse(bytes: &[u8], limits: &Limits) -> Result<ObjGeometry> {
    let mut geometry = ObjGeometry { origin: far_origin(bytes), ..ObjGeometry::default() };
    let mut lines = Lines::new(bytes);
    let mut material = NONE;
    let mut triangles: u64 = 0;
    let most_vertices = limits.max_triangles.saturating_mul(3).min(u64::from(NONE) - 1) as usize;
    // Names are few but faces that switch between them may be many.
    let mut known = std::collections::BTreeMap::new();
    while let Some((number, line)) = lines.next_line() {
        let (key, rest) = keyword(line);
        match key {
            b"v" => vertex(&mut geometry, rest, number)?,
            b"vt" => {
                let [u, v, _] = numbers(rest, number)?;
                geometry.uvs.push([u, v]);
            }
            b"vn" => geometry.normals.push(normal(rest, number)?),
            b"f" | b"fo" => {
                let count = face(&mut geometry, rest, material, number)?;
                triangles += count.saturating_sub(2);
                if triangles > limits.max_triangles {
                    let message = format!("line {number}: the model has more than {} triangles", limits.max_triangles);
                    return Err(Failure::new(Code::TooLarge, message));
                }
            }
            b"usemtl" => {
                let next = known.len() as u32;
                if next as usize > MOST_MATERIALS {
                    let message = format!("line {number}: the model has more than {MOST_MATERIALS} materials");
                    return Err(Failure::new(Code::TooLarge, message));
                }
                let name = from_bytes(rest);
                material = *known.entry(name).or_insert_with_key(|name| {
                    geometry.materials.push(name.clone());
                    next
                });
            }
            b"mtllib" => geometry.libraries.push(from_bytes(rest)),
            b"o" if geometry.name.is_none() && !rest.is_empty() => {
                geometry.name = Some(from_bytes(rest));
            }
            b"l" | b"p" | b"curv" | b"curv2" | b"surf" => geometry.others += 1,
            _ => {}
        }
        if geometry.positions.len().max(geometry.uvs.len()).max(geometry.normals.len()) > most_vertices {
            let message = format!("line {number}: the model has more than {most_vertices} vertices");
            return Err(Failure::new(Code::TooLarge, message));
        }
    }
    if geometry.uvs.is_empty() {
        geometry.lacks_uvs = lacks_uvs(&geometry);
        geometry.corners.iter_mut().for_each(|corner| corner[1] = NONE);
    }
    check(&geometry)?;
    hold_back(&mut geometry);
    Ok(geometry)
}

/// Leaves out the faces of which a position is not finite, and takes their texture coordinates from those of which one of these is not.
fn hold_back(geometry: &mut ObjGeometry) {
    let bad = |numbers: &[f32]| numbers.iter().any(|x| !x.is_finite());
    if !geometry.positions.iter().any(|p| bad(p)) && !geometry.uvs.iter().any(|uv| bad(uv)) {
        return;
    }
    let mut faces = std::mem::take(&mut geometry.faces);
    faces.retain(|face| {
        let is_bad = geometry.corners_of(face).iter().any(|c| bad(&geometry.positions[c[0] as usize]));
        if is_bad {
            geometry.without_position.get_or_insert((0, face.line as usize)).0 += 1;
            return false;
        }
        let has_bad_uv = |c: &Corner| geometry.uvs.get(c[1] as usize).is_some_and(|uv| bad(uv));
        if geometry.corners_of(face).iter().any(has_bad_uv) {
            geometry.without_uv.get_or_insert((0, face.line as usize)).0 += 1;
            let start = face.start as usize;
            geometry.corners[start..start + face.count as usize].iter_mut().for_each(|corner| corner[1] = NONE);
        }
        true
    });
    geometry.faces = faces;
}

/// The middle of a model in whole units where that is so far from the origin that 32 bits would move its vertices by more than some millionths of its extent.
fn far_origin(bytes: &[u8]) -> Option<[f64; 3]> {
    let mut lines = Lines::new(bytes);
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    while let Some((_, line)) = lines.next_line() {
        let (b"v", rest) = keyword(line) else { continue };
        let mut own = [0.0; 3];
        for (slot, word) in own.iter_mut().zip(words(rest)) {
            *slot = double(word).unwrap_or(f64::NAN);
        }
        // What is no place is nowhere.
        if own.iter().any(|v| v.is_nan()) {
            continue;
        }
        // One that is near is enough: what holds it too is as large as it is far away.
        if own.iter().all(|v| v.abs() < NEAR) {
            return None;
        }
        for k in 0..3 {
            (low[k], high[k]) = (low[k].min(own[k]), high[k].max(own[k]));
        }
    }
    is_far(low, high).then(|| [0, 1, 2].map(|k| (0.5 * (low[k] + high[k])).round()))
}

/// A finite number in 64 bits.
fn double(word: &[u8]) -> Option<f64> {
    std::str::from_utf8(word).ok()?.parse().ok().filter(|v: &f64| v.is_finite())
}

/// The line of the first face that names a texture coordinate.
fn lacks_uvs(geometry: &ObjGeometry) -> Option<u32> {
    let named = |face: &&Face| geometry.corners_of(face).iter().any(|corner| corner[1] != NONE);
    geometry.faces.iter().find(named).map(|face| face.line)
}

fn vertex(geometry: &mut ObjGeometry, rest: &[u8], line: usize) -> Result<()> {
    let mut values = [0.0_f32; 7];
    let mut count = 0;
    for word in words(rest) {
        // Anything beyond a position and its colour is somebody's own.
        let Some(slot) = values.get_mut(count) else { break };
        *slot = match geometry.origin.and_then(|origin| origin.get(count).copied()) {
            Some(origin) => double(word).map_or_else(|| number(word, line), |v| Ok((v - origin) as f32))?,
            None => number(word, line)?,
        };
        count += 1;
    }
    let [x, y, z, r, g, b, _] = values;
    if count < 3 {
        return Err(Failure::model(format!("line {line}: a vertex has three coordinates, and this has {count}")));
    }
    if count >= 6 {
        geometry.colors.resize(geometry.positions.len(), [1.0; 3]);
        geometry.colors.push([r, g, b].map(|c| if c.is_finite() { c } else { 1.0 }));
    }
    geometry.positions.push([x, y, z]);
    Ok(())
}

/// One to three numbers; what is missing is 0.
fn numbers(rest: &[u8], line: usize) -> Result<[f32; 3]> {
    let mut values = [0.0; 3];
    let mut count = 0;
    for (slot, word) in values.iter_mut().zip(words(rest)) {
        *slot = number(word, line)?;
        count += 1;
    }
    if count == 0 {
        return Err(Failure::model(format!("line {line}: a number is expected, and there is none")));
    }
    Ok(values)
}

/// A normal. Scanners write NaN where no area lies about a vertex: such a normal has no direction, and is zero here.
fn normal(rest: &[u8], line: usize) -> Result<[f32; 3]> {
    let mut values = [f32::NAN; 3];
    for (slot, word) in values.iter_mut().zip(words(rest)) {
        *slot = number(word, line)?;
    }
    Ok(if values.iter().all(|v| v.is_finite()) { values } else { [0.0; 3] })
}

fn number(word: &[u8], line: usize) -> Result<f32> {
    float(word).ok_or_else(|| Failure::model(format!("line {line}: {} is not a number", quote_bytes(word))))
}

/// Reads a face; gives the number of its corners.
fn face(geometry: &mut ObjGeometry, rest: &[u8], material: u32, line: usize) -> Result<u64> {
    let start = geometry.corners.len();
    for word in words(rest) {
        let mut parts = word.split(|b| *b == b'/');
        let mut part = |count: usize, what: &str| match parts.next() {
            None | Some([]) => Ok(NONE),
            Some(text) => index(text, count, what, line),
        };
        let corner = [
            part(geometry.positions.len(), "position")?,
            part(geometry.uvs.len(), "texture coordinate")?,
            part(geometry.normals.len(), "normal")?,
        ];
        if corner[0] == NONE || parts.next().is_some() {
            return Err(Failure::model(format!("line {line}: {} is not a corner of a face", quote_bytes(word))));
        }
        geometry.corners.push(corner);
    }
    let count = geometry.corners.len() - start;
    if count < 3 {
        geometry.corners.truncate(start);
        geometry.thin.get_or_insert((0, line)).0 += 1;
        return Ok(0);
    }
    let too_large = |_| Failure::new(Code::TooLarge, format!("line {line}: the model has too many faces"));
    let start = u32::try_from(start).map_err(too_large)?;
    geometry.faces.push(Face { start, count: count as u32, material, line: line as u32 });
    Ok(count as u64)
}

/// An index from 1, or from -1 backwards, as one from 0. Those above `count` may still come: they are checked at the end.
fn index(text: &[u8], count: usize, what: &str, line: usize) -> Result<u32> {
    let value = integer(text)
        .ok_or_else(|| Failure::model(format!("line {line}: {} is not a {what} index", quote_bytes(text))))?;
    let from_zero = if value < 0 { value + count as i64 } else { value - 1 };
    u32::try_from(from_zero)
        .ok()
        .filter(|i| *i < NONE)
        .ok_or_else(|| Failure::model(format!("line {line}: {what} {value} is out of range, {count} are known here")))
}

fn check(geometry: &ObjGeometry) -> Result<()> {
    let counts = [geometry.positions.len(), geometry.uvs.len(), geometry.normals.len()];
    for face in &geometry.faces {
        for corner in geometry.corners_of(face) {
            for ((index, count), what) in corner.iter().zip(counts).zip(["position", "texture coordinate", "normal"]) {
                if *index != NONE && *index as usize >= count {
                    let message =
                        format!("line {}: {what} {} is out of range, there are {count}", face.line, index + 1);
                    return Err(Failure::model(message));
                }
            }
        }
    }
    Ok(())
}
