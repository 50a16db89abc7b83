//! Images of several kinds made one, so that they can share a sheet.

use super::{Direction, Image, Role, Samples};

impl Image {
    /// The same picture with `channels` channels (1, 2, 3 or 4) and 8 or 16 bits: grey becomes RGB, alpha that is missing is
    /// opaque. Nothing is lost as long as there are not fewer channels or bits than before.
    pub fn widened(self, channels: u8, depth: u8) -> Image {
        let deep = matches!(self.samples, Samples::U16(_));
        if self.channels == channels && deep == (depth == 16) {
            return self;
        }
        let own = usize::from(self.channels.max(1));
        let samples = match self.samples {
            Samples::U8(s) if depth == 16 => {
                let wide: Vec<u16> = s.iter().map(|v| u16::from(*v) * 257).collect();
                Samples::U16(spread(&wide, own, usize::from(channels), u16::MAX))
            }
            Samples::U8(s) => Samples::U8(spread(&s, own, usize::from(channels), u8::MAX)),
            Samples::U16(s) => Samples::U16(spread(&s, own, usize::from(channels), u16::MAX)),
        };
        Image { channels, samples, ..self }
    }

    /// One texel that leaves a material as it is: white, a flat normal, or the full anisotropy along the tangent.
    pub fn neutral(role: Role, channels: u8, depth: u8) -> Image {
        let flat: [u8; 4] = match role.direction() {
            Some(Direction::Normal) => [128, 128, 255, 255],
            Some(Direction::Anisotropy) => [255, 128, 255, 255],
            None => [255; 4],
        };
        let samples = Samples::U8(flat.into_iter().take(usize::from(channels)).collect());
        Image { width: 1, height: 1, channels, samples }.widened(channels, depth)
    }
}

fn spread<T: Copy>(samples: &[T], from: usize, to: usize, opaque: T) -> Vec<T> {
    let mut out = Vec::with_capacity(samples.len() / from * to);
    for texel in samples.chunks_exact(from) {
        let alpha = if from.is_multiple_of(2) { texel[from - 1] } else { opaque };
        let colour = |c: usize| if from >= 3 { texel[c] } else { texel[0] };
        out.extend((0..to).map(|c| if to.is_multiple_of(2) && c == to - 1 { alpha } else { colour(c) }));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grey_becomes_colour_and_alpha_opaque() {
        let image =
            |channels: u8, samples: Vec<u8>| Image { width: 1, height: 1, channels, samples: Samples::U8(samples) };
        assert_eq!(image(1, vec![7]).widened(4, 8), image(4, vec![7, 7, 7, 255]));
        assert_eq!(image(2, vec![7, 9]).widened(4, 8), image(4, vec![7, 7, 7, 9]));
        assert_eq!(image(1, vec![7]).widened(2, 8), image(2, vec![7, 255]));
        assert_eq!(image(3, vec![1, 2, 3]).widened(4, 16).samples, Samples::U16(vec![257, 514, 771, 65535]));
        assert_eq!(image(3, vec![1, 2, 3]).widened(3, 8), image(3, vec![1, 2, 3]));
        assert_eq!(Image::neutral(Role::Normal, 3, 8), image(3, vec![128, 128, 255]));
        assert_eq!(Image::neutral(Role::Anisotropy, 3, 8), image(3, vec![255, 128, 255]));
    }
}
