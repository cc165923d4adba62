#include "texture/texture.h"

namespace edgegrad {

Footprint footprint_of_sampler(const TexelGrid& t, Vec2 uv) {
    const Vec2 p = t.place(uv);
    if (t.sampler.filter == TextureFilter::nearest) return texel_at(t, std::floor(p.x), std::floor(p.y));
    const double i = std::floor(p.x - 0.5), j = std::floor(p.y - 0.5);
    return footprint_at(t, i, j, p.x - 0.5 - i, p.y - 0.5 - j);
}

}  // namespace edgegrad
