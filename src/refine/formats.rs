//! In which format a refined texture is written, and what is to be said about it.

use image::{ColorType, DynamicImage};

use crate::error::Warning;
use crate::texture::Slot;
use crate::texture::{
    Alpha, BASIS_BLOCK, BASIS_SIDE, BasisCoding, BasisKind, BasisUpload, Coding, Format, JpegCoding, JpegQuality,
    MipFilter, Texture, TextureFormat, WEBP_SIDE, WebpQuality,
};

/// An uploaded file that a slot is read from.
#[derive(Debug, Clone)]
pub(super) struct Upload {
    /// Container.
    pub format: Format,
    /// Whether it was compressed with a loss.
    pub lossy: bool,
    /// Size of the file.
    pub bytes: u64,
    /// Width times height.
    pub texels: u64,
    /// How it was encoded, of a JPEG.
    pub jpeg: Option<JpegCoding>,
    /// Its quality in 0..=100, of a lossy WebP file.
    pub webp: Option<u8>,
    /// What it takes with it, of a KTX2 file with blocks of Basis Universal.
    pub basis: Option<BasisUpload>,
}

impl Upload {
    /// What its format is called, if `keep` does not write it.
    fn replaced(&self) -> Option<&'static str> {
        (self.format == Format::Ktx2 && self.basis.is_none()).then_some("KTX2 without Basis Universal")
    }
}

/// What a page is like, as far as formats ask.
#[derive(Debug, Clone, Copy)]
pub(super) struct PageKind {
    /// Channels and depth.
    pub colour: ColorType,
    /// Width and height.
    pub size: [u32; 2],
}

impl PageKind {
    /// That of an image.
    pub(super) fn of(image: &DynamicImage) -> Self {
        PageKind { colour: image.color(), size: [image.width(), image.height()] }
    }
}

/// Bytes a texel, of those of the upload, from which it is said.
const HEAVIER: f64 = 1.3;

/// What the options make of a slot.
pub(super) struct Plan<'a> {
    slot: &'a Slot,
    uploads: Vec<Upload>,
    /// Format of every page that it can hold, and how it is encoded.
    wanted: Coding,
    /// Whether the format of the upload was to be kept.
    keep: bool,
    /// Whether the options say how much JPEG files lose.
    has_quality: bool,
}

impl<'a> Plan<'a> {
    /// A slot that is read from `uploads`.
    pub(super) fn new(slot: &'a Slot, uploads: Vec<Upload>, options: &Texture) -> Self {
        let asked = options.format.of(slot.role);
        let format = match asked {
            TextureFormat::Keep if uploads.iter().any(|u| u.replaced().is_some()) => Format::Png,
            TextureFormat::Keep => slot.header.format,
            TextureFormat::Png => Format::Png,
            TextureFormat::Jpeg => Format::Jpeg,
            TextureFormat::Webp => Format::Webp,
            TextureFormat::Ktx2 | TextureFormat::Ktx2Etc1s | TextureFormat::Ktx2Uastc => Format::Ktx2,
        };
        let jpeg = || match options.jpeg_quality {
            JpegQuality::Quality(quality) => JpegCoding::of_quality(quality),
            JpegQuality::Keep => {
                uploads.iter().filter_map(|u| u.jpeg.clone()).reduce(JpegCoding::finer).unwrap_or_default()
            }
        };
        let webp = || match options.webp_quality {
            WebpQuality::Quality(quality) => Some(quality),
            WebpQuality::Lossless => None,
            // What one of them shows without loss, all show so.
            WebpQuality::Keep if uploads.iter().any(|u| !u.lossy) => None,
            WebpQuality::Keep => uploads.iter().filter_map(|u| u.webp).max(),
        };
        let basis = || {
            let filter = MipFilter::of(slot.role, slot.alpha == Alpha::Blend);
            let known: Vec<&BasisUpload> = uploads.iter().filter_map(|u| u.basis.as_ref()).collect();
            let kind = match asked {
                TextureFormat::Ktx2Etc1s => Some(BasisKind::Etc1s),
                TextureFormat::Ktx2Uastc => Some(BasisKind::Uastc),
                _ => None,
            };
            BasisCoding::of(&known, kind, filter, slot.mipmaps)
        };
        let wanted = match format {
            Format::Jpeg => Coding::Jpeg(jpeg()),
            Format::Webp => Coding::Webp(webp()),
            Format::Ktx2 => Coding::Basis(basis()),
            Format::Png => Coding::Png,
        };
        Plan {
            slot,
            uploads,
            wanted,
            keep: asked == TextureFormat::Keep,
            has_quality: options.jpeg_quality != JpegQuality::Keep,
        }
    }

    /// The format of a page: PNG where the one that is wanted cannot hold it.
    pub(super) fn of(&self, page: PageKind) -> &Coding {
        if self.obstacle(page).is_some() { &Coding::Png } else { &self.wanted }
    }

    /// Texels about each chart that are taken from the uploaded image: of KTX2 those of the chart's blocks, which can be kept as they are; of files
    /// that lose nothing a gutter; of others half of that, because what lies beyond is filled with means, which cost less in a file.
    pub(super) fn bleed(&self) -> u32 {
        match self.wanted {
            Coding::Basis(_) => BASIS_BLOCK + 1,
            Coding::Png | Coding::Webp(None) => 4,
            Coding::Jpeg(_) | Coding::Webp(Some(_)) => 2,
        }
    }

    /// How all pages are encoded, if they are JPEG files.
    pub(super) fn jpeg(&self, pages: &[PageKind]) -> Option<&JpegCoding> {
        match &self.wanted {
            Coding::Jpeg(coding) if pages.iter().all(|page| self.obstacle(*page).is_none()) => Some(coding),
            _ => None,
        }
    }

    /// What the wanted format cannot hold.
    fn obstacle(&self, page: PageKind) -> Option<&'static str> {
        let PageKind { colour, size: [width, height] } = page;
        let deep = colour.bytes_per_pixel() > colour.channel_count();
        match self.wanted.format() {
            Format::Jpeg if deep || colour.has_alpha() => Some("alpha or 16 bits, which JPEG cannot hold"),
            Format::Webp if deep => Some("16 bits, which WebP cannot hold"),
            Format::Webp if width.max(height) > WEBP_SIDE => Some("a side that is too long for WebP"),
            Format::Ktx2 if deep => Some("16 bits, which Basis Universal cannot hold"),
            Format::Ktx2 if width.max(height) > BASIS_SIDE => {
                Some("a side that is too long for its mip levels in KTX2")
            }
            Format::Ktx2 if !width.is_multiple_of(BASIS_BLOCK) || !height.is_multiple_of(BASIS_BLOCK) => {
                Some("sides that are no multiples of 4, as KTX2 asks for (set texture.multiple_of)")
            }
            _ => None,
        }
    }

    /// What the user may not expect of the pages, written in `after` bytes.
    pub(super) fn warnings(&self, pages: &[PageKind], after: u64) -> Vec<Warning> {
        let name = &self.slot.name;
        let mut all = Vec::new();
        let mut warn = |code: &str, text: String| {
            all.push(Warning::new(code, text).at(format!("/images/{}", self.slot.image)));
        };
        if let Some(obstacle) = pages.iter().find_map(|page| self.obstacle(*page)) {
            warn("kept_png", format!("{name} has {obstacle}: it is written as PNG"));
        }
        let loses =
            |page: &PageKind| matches!(self.of(*page), Coding::Jpeg(_) | Coding::Webp(Some(_)) | Coding::Basis(_));
        if self.uploads.iter().any(|u| u.lossy) && pages.iter().any(loses) {
            let text =
                "was compressed with a loss and is compressed once more (set texture.format to \"png\" to avoid that)";
            warn("lossy_reencode", format!("{name} {text}"));
        }
        let before: u64 = self.uploads.iter().map(|u| u.bytes).sum();
        if let Some(uploaded) = self.uploads.iter().find_map(Upload::replaced).filter(|_| self.keep) {
            let text = format!("{name} was {uploaded} of {before} bytes and is written as PNG of {after} bytes");
            warn("reencoded_png", text);
            return all;
        }
        let texels_before: u64 = self.uploads.iter().map(|u| u.texels).sum();
        let texels: u64 = pages.iter().map(|page| u64::from(page.size[0]) * u64::from(page.size[1])).sum();
        let bits = |bytes: u64, texels: u64| 8.0 * bytes as f64 / texels.max(1) as f64;
        let (was, is) = (bits(before, texels_before), bits(after, texels));
        if is > HEAVIER * was {
            let now = pages.first().map_or(self.wanted.format(), |page| self.of(*page).format());
            let why = if self.uploads.iter().any(|u| u.format != now) {
                "its format changed".to_owned()
            } else if now == Format::Jpeg && self.has_quality {
                "its quality is the one that texture.jpeg_quality asks for; \"keep\" takes that of the upload"
                    .to_owned()
            } else {
                "less of it is empty, and its parts were put together anew".to_owned()
            };
            let text = format!(
                "{name} takes {after} bytes for {texels} texels, {is:.2} bits each; its upload took {before} bytes for {texels_before}, {was:.2} each: {why}"
            );
            warn("heavier_texture", text);
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::asset::fixture;
    use crate::texture::from_samples;

    fn page(channels: u8, deep: bool, width: u32) -> DynamicImage {
        let count = width as usize * usize::from(channels);
        match deep {
            true => from_samples([width, 1], channels, vec![0u16; count]).unwrap(),
            false => from_samples([width, 1], channels, vec![0u8; count]).unwrap(),
        }
    }

    fn to(format: TextureFormat) -> Texture {
        Texture { format: format.into(), ..Texture::default() }
    }

    /// The format that a page becomes, and the codes of the warnings.
    fn written(uploaded: Format, lossy: bool, wanted: TextureFormat, page: DynamicImage) -> (Format, Vec<String>) {
        let mut slot = fixture::slot(0, [8, 8]);
        slot.header.format = uploaded;
        let plan = Plan::new(
            &slot,
            vec![Upload {
                format: uploaded,
                lossy,
                bytes: 1_000_000,
                texels: 1,
                jpeg: None,
                webp: (uploaded == Format::Webp && lossy).then_some(80),
                basis: None,
            }],
            &to(wanted),
        );
        let format = plan.of(PageKind::of(&page)).format();
        (format, plan.warnings(&[PageKind::of(&page)], 250).into_iter().map(|w| w.code).collect())
    }

    #[test]
    fn keep_keeps_what_is_written_and_tells_of_the_rest() {
        let keep = |format, lossy, channels| written(format, lossy, TextureFormat::Keep, page(channels, false, 8));
        assert_eq!(keep(Format::Png, false, 4), (Format::Png, vec![]));
        assert_eq!(keep(Format::Webp, false, 4), (Format::Webp, vec![]));
        assert_eq!(keep(Format::Jpeg, true, 3), (Format::Jpeg, vec!["lossy_reencode".to_owned()]));
        assert_eq!(keep(Format::Webp, true, 4), (Format::Webp, vec!["lossy_reencode".to_owned()]));
        assert_eq!(keep(Format::Ktx2, true, 3), (Format::Png, vec!["reencoded_png".to_owned()]));
    }

    #[test]
    fn png_takes_what_a_format_cannot_hold() {
        let to = |format, page| written(Format::Png, false, format, page);
        let kept = || (Format::Png, vec!["kept_png".to_owned()]);
        assert_eq!(to(TextureFormat::Jpeg, page(3, false, 8)), (Format::Jpeg, vec![]));
        assert_eq!(to(TextureFormat::Jpeg, page(4, false, 8)), kept());
        assert_eq!(to(TextureFormat::Jpeg, page(3, true, 8)), kept());
        assert_eq!(to(TextureFormat::Webp, page(2, false, 8)), (Format::Webp, vec![]));
        assert_eq!(to(TextureFormat::Webp, page(4, true, 8)), kept());
        assert_eq!(to(TextureFormat::Webp, page(1, false, 16_383)), (Format::Webp, vec![]));
        assert_eq!(to(TextureFormat::Webp, page(1, false, 16_384)), kept());
    }

    #[test]
    fn a_chosen_format_is_no_surprise_but_a_second_loss_is() {
        let to = |format| written(Format::Ktx2, true, format, page(3, false, 8));
        assert_eq!(to(TextureFormat::Png), (Format::Png, vec![]));
        assert_eq!(to(TextureFormat::Webp), (Format::Webp, vec![]));
        assert_eq!(to(TextureFormat::Jpeg), (Format::Jpeg, vec!["lossy_reencode".to_owned()]));
    }

    #[test]
    fn the_bytes_before_and_after_are_named() {
        // Of two models that share a sheet, one brings what is not written.
        let slot = fixture::slot(0, [8, 8]);
        let upload =
            |format, lossy, bytes| Upload { format, lossy, bytes, texels: 64, jpeg: None, webp: None, basis: None };
        let uploads = vec![upload(Format::Png, false, 70), upload(Format::Ktx2, true, 31)];
        let plan = Plan::new(&slot, uploads, &to(TextureFormat::Keep));
        let warning = plan.warnings(&[PageKind::of(&page(3, false, 8))], 250).remove(0);
        assert!(warning.message.contains("101 bytes") && warning.message.contains("250 bytes"), "{}", warning.message);
        assert_eq!((warning.code.as_str(), warning.pointer.as_deref()), ("reencoded_png", Some("/images/0")));
    }

    #[test]
    fn more_bytes_a_texel_are_told_with_their_reason() {
        let mut slot = fixture::slot(0, [8, 8]);
        slot.header.format = Format::Jpeg;
        let told = |after: u64, options: Texture| {
            let upload = Upload {
                format: Format::Jpeg,
                lossy: true,
                bytes: 400,
                texels: 800,
                jpeg: None,
                webp: None,
                basis: None,
            };
            let told = Plan::new(&slot, vec![upload], &options).warnings(&[PageKind::of(&page(3, false, 400))], after);
            told.into_iter().find(|w| w.code == "heavier_texture").map(|w| w.message)
        };
        assert_eq!(told(215, to(TextureFormat::Keep)), None);
        let packed = told(300, to(TextureFormat::Keep)).unwrap();
        assert!(
            packed.contains("300 bytes for 400 texels, 6.00 bits each") && packed.contains("4.00 each"),
            "{packed}"
        );
        assert!(packed.contains("less of it is empty"), "{packed}");
        assert!(told(300, to(TextureFormat::Png)).unwrap().contains("its format changed"));
        let quality = Texture { jpeg_quality: JpegQuality::Quality(95), ..Texture::default() };
        assert!(told(300, quality).unwrap().contains("texture.jpeg_quality"));
    }
}
