//! 3D Tiles 1.0: the containers .b3dm (batched models) and .i3dm (instances of a model), which hold a GLB behind their feature table and batch table
//! (3D Tiles 1.0, sections 10 and 11).

use super::document::Document;
use super::glb::word;
use crate::error::{Code, Failure, Result, Warning};

/// Bytes that are enough to find out what a tile is and where its GLB begins.
pub(crate) const HEAD: usize = 32;
/// The GLB and the end of the tile lie on multiples of this, and so does the end of each table.
const ALIGNMENT: usize = 8;
/// A length at least this great is none, but the first four letters of JSON or of the GLB magic: the tile has an older, shorter header.
const NO_LENGTH: u32 = 0x2200_0000;

/// Which tile it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TileKind {
    /// Batched 3D model.
    B3dm,
    /// Instanced 3D model.
    I3dm,
}

impl TileKind {
    /// Extension of its files, which is its magic as well.
    pub fn extension(self) -> &'static str {
        match self {
            TileKind::B3dm => "b3dm",
            TileKind::I3dm => "i3dm",
        }
    }

    /// Bytes of its header.
    fn header(self) -> u32 {
        match self {
            TileKind::B3dm => 28,
            TileKind::I3dm => 32,
        }
    }
}

/// What stood about the GLB of a tile, to be put about it again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tile {
    /// Which tile it is.
    pub kind: TileKind,
    /// Feature table and batch table: JSON and binary of each.
    tables: [Vec<u8>; 4],
}

/// The header of a tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TileHeader {
    /// Which tile it is.
    pub(crate) kind: TileKind,
    /// Lengths of the header itself, and of JSON and binary of feature table and batch table.
    lengths: [u32; 5],
    /// Number of batches, where an older header holds it.
    batches: Option<u32>,
    /// Bytes of the tile.
    pub(crate) length: u64,
}

/// Whether the bytes begin as a tile does, of whichever format.
pub(crate) fn is_tile(bytes: &[u8]) -> bool {
    [b"b3dm", b"i3dm", b"cmpt", b"pnts"].iter().any(|magic| bytes.starts_with(*magic))
}

impl TileHeader {
    /// Reads a header from the first bytes of a tile, [`HEAD`] where there are as many. `there` is how many the file has.
    ///
    /// # Errors
    /// `unsupported_media_type` for tiles that hold no GLB, `invalid_model` for a broken header.
    pub(crate) fn read(head: &[u8], there: u64) -> Result<Self> {
        let kind = match head.get(..4) {
            Some(b"b3dm") => TileKind::B3dm,
            Some(b"i3dm") => TileKind::I3dm,
            Some(b"cmpt") => {
                let tiles = word(head, 12).map_or_else(String::new, |n| format!(" of {n} tiles"));
                let message = format!(
                    "a .cmpt is a composite{tiles}, each with a glTF of its own: split it (`3d-tiles-tools splitCmpt`) and refine the .b3dm and .i3dm that come out"
                );
                return Err(Failure::new(Code::UnsupportedMediaType, message));
            }
            Some(b"pnts") => {
                let message = "a .pnts is a cloud of points: it has no triangles, and no textures to refine";
                return Err(Failure::new(Code::UnsupportedMediaType, message));
            }
            _ => return Err(Failure::model("the file does not begin with the magic of a tile, \"b3dm\" or \"i3dm\"")),
        };
        let name = kind.extension();
        let field = |at: usize| {
            let needed = kind.header();
            let message = format!("the {name} header is truncated: {needed} bytes are needed, {there} are there");
            word(head, at).ok_or_else(|| Failure::model(message))
        };
        let (version, length) = (field(4)?, u64::from(field(8)?));
        if version != 1 {
            return Err(Failure::model(format!("{name} version {version} is not supported, only version 1 is")));
        }
        let fields = [field(12)?, field(16)?, field(20)?, field(24)?];
        let header = match (kind, fields) {
            (TileKind::B3dm, [batches, json, letters, _]) if letters >= NO_LENGTH => {
                TileHeader { kind, lengths: [20, 0, 0, json, 0], batches: Some(batches), length }
            }
            (TileKind::B3dm, [json, binary, batches, letters]) if letters >= NO_LENGTH => {
                TileHeader { kind, lengths: [24, 0, 0, json, binary], batches: Some(batches), length }
            }
            (_, [a, b, c, d]) => TileHeader { kind, lengths: [kind.header(), a, b, c, d], batches: None, length },
        };
        if length > there {
            let message = format!(
                "the {name} header declares {length} bytes, and the file has {there}: it is truncated or damaged"
            );
            return Err(Failure::model(message));
        }
        if header.glb() > length {
            let tables = header.glb() - u64::from(header.lengths[0]);
            let message =
                format!("the tables of the {name} declare {tables} bytes, more than the {length} of the tile hold");
            return Err(Failure::model(message));
        }
        if kind == TileKind::I3dm {
            match field(28)? {
                1 => {}
                0 => {
                    let message = "the i3dm names its glTF by a URI (gltfFormat 0) and holds none: refine the file that it names, and keep the i3dm as it is";
                    return Err(Failure::new(Code::UnsupportedMediaType, message));
                }
                other => return Err(Failure::model(format!("the gltfFormat of the i3dm is {other}, not 0 or 1"))),
            }
        }
        Ok(header)
    }

    /// Where the GLB begins.
    pub(crate) fn glb(&self) -> u64 {
        self.lengths.iter().map(|n| u64::from(*n)).sum()
    }
}

/// Takes a tile apart: what stands about the GLB, and the GLB.
///
/// # Errors
/// As [`TileHeader::read`].
pub(crate) fn parse<'a>(bytes: &'a [u8], warnings: &mut Vec<Warning>) -> Result<(Tile, &'a [u8])> {
    let header = TileHeader::read(bytes, bytes.len() as u64)?;
    let name = header.kind.extension();
    let cut = || Failure::model(format!("the {name} is truncated"));
    let end = usize::try_from(header.length).map_err(|_| cut())?;
    let whole = bytes.get(..end).ok_or_else(cut)?;
    if end < bytes.len() {
        let message = format!("{} bytes after the end of the {name} are ignored", bytes.len() - end);
        warnings.push(Warning::new("trailing_bytes", message));
    }
    let [mut at, lengths @ ..] = header.lengths.map(|n| n as usize);
    let mut tables: [Vec<u8>; 4] = Default::default();
    for (table, length) in tables.iter_mut().zip(lengths) {
        let to = at.checked_add(length).ok_or_else(cut)?;
        *table = whole.get(at..to).ok_or_else(cut)?.to_vec();
        at = to;
    }
    if let Some(batches) = header.batches {
        tables[0] = format!("{{\"BATCH_LENGTH\":{batches}}}").into_bytes();
    }
    let rest = whole.get(at..).ok_or_else(cut)?;
    // What fills the tile to a multiple of 8 belongs to it and not to the GLB.
    let own = word(rest, 8).map(|n| n as usize).filter(|n| rest.len().saturating_sub(*n) < ALIGNMENT);
    Ok((Tile { kind: header.kind, tables }, own.and_then(|n| rest.get(..n)).unwrap_or(rest)))
}

impl Tile {
    /// Puts a tile together about a GLB whose length is a multiple of 8.
    ///
    /// # Errors
    /// `too_large` when it would not fit in the 4 GiB that the header can declare.
    fn wrap(&self, glb: &[u8]) -> Result<Vec<u8>> {
        let header = self.kind.header() as usize;
        let mut tables = self.tables.each_ref().map(Vec::as_slice);
        if tables.iter().all(|table| table.is_empty()) && !header.is_multiple_of(ALIGNMENT) {
            // The header alone ends nowhere; the feature table is required to have this number.
            tables[0] = b"{\"BATCH_LENGTH\":0}";
        }
        let mut body = Vec::new();
        let mut lengths = [0; 4];
        for ((table, filler), length) in tables.into_iter().zip([b' ', 0, b' ', 0]).zip(&mut lengths) {
            let start = body.len();
            body.extend_from_slice(table);
            if !table.is_empty() {
                body.resize((header + body.len()).next_multiple_of(ALIGNMENT) - header, filler);
            }
            *length = body.len() - start;
        }
        let total = header + body.len() + glb.len();
        let too_large = |_| {
            Failure::new(Code::TooLarge, format!("the tile takes {total} bytes, and its header holds at most 4 GiB"))
        };
        let mut out = Vec::with_capacity(total);
        out.extend_from_slice(self.kind.extension().as_bytes());
        for value in [1, total].into_iter().chain(lengths) {
            out.extend_from_slice(&u32::try_from(value).map_err(too_large)?.to_le_bytes());
        }
        if self.kind == TileKind::I3dm {
            out.extend_from_slice(&1u32.to_le_bytes());
        }
        out.extend_from_slice(&body);
        out.extend_from_slice(glb);
        Ok(out)
    }
}

impl Document {
    /// The document as the tile that it came in; none where it came in none.
    ///
    /// # Errors
    /// As [`Document::to_glb`].
    pub fn to_tile(&self) -> Result<Option<Vec<u8>>> {
        let Some(tile) = &self.tile else { return Ok(None) };
        tile.wrap(&self.to_aligned_glb(ALIGNMENT)?).map(Some)
    }
}
