// Finds pixels that contain discontinuities, where one point of a face represents the pixel poorly. These are shadows
// of punctual lights, and edges of nearest texels. With path tracing, they are also the borders of emitters, which are
// brighter than all that they light.
//
// A pixel is marked where the pixels around it are on both sides. The pixel's own result is not used: whether it is
// shaded again, at other points, must not depend on the points that this discards. Otherwise the mean over seeds would
// be biased. edgegrad/points/discontinuous_pixels.py has the same rule for shaders.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <vector>

#include "core/parallel.h"
#include "core/sampler.h"
#include "shading/lit/lit_scene.h"

namespace edgegrad {

constexpr int most_again = 8;   // limit of the factor on the points per face and pixel where it is shaded again
constexpr int share_again = 4;  // limit of the factor on the points of the first pass, in total
// Path tracing follows many paths per pixel. These are its factors on the points per face, and on the camera's rays.
constexpr int points_again = 2, rays_again = 4;

// Holds an image of values with a border of one pixel, where nothing is known.
template <class V>
class PaddedImage {
   public:
    PaddedImage(int width, int height, size_t each, V nothing)
        : width_(width), each_(each), values_(size_t(width + 2) * size_t(height + 2) * each, nothing) {}

    V* at(int x, int y) { return values_.data() + index(x, y); }
    const V* at(int x, int y) const { return values_.data() + index(x, y); }

   private:
    size_t index(int x, int y) const { return (size_t(y + 1) * (width_ + 2) + x + 1) * each_; }

    int width_;
    size_t each_;
    std::vector<V> values_;
};

// Records which punctual lights pixels see.
class LightVisibility {
   public:
    LightVisibility(int width, int height, const LitScene& lit, const LitOptions& options)
        : width_(width), columns_(columns(lit, options)), seen_(width, height, columns_.size(), 0) {}

    bool empty() const { return columns_.empty(); }

    // Adds one point.
    void add(int x, int y, const int8_t* seen) {
        uint8_t* here = seen_.at(x, y);
        for (size_t l = 0; l < columns_.size(); ++l)
            if (const int8_t s = seen[columns_[l]]; s != not_sampled) here[l] |= s ? visible : hidden;
    }

    // Marks such pixels in a row.
    void mark(int y, uint8_t* pixels) const {
        const size_t L = columns_.size(), n = L * width_;
        const uint8_t *above = seen_.at(0, y - 1), *row = seen_.at(0, y), *below = seen_.at(0, y + 1);
        std::vector<uint8_t> both(n);
        for (size_t e = 0; e < n; ++e)
            both[e] = (above + e)[-ptrdiff_t(L)] | above[e] | above[e + L] | (row + e)[-ptrdiff_t(L)] | row[e + L] |
                      (below + e)[-ptrdiff_t(L)] | below[e] | below[e + L];
        for (size_t e = 0; e < n; ++e)
            if (both[e] == (hidden | visible)) pixels[e / L] = 1;
    }

   private:
    enum : uint8_t { hidden = 1, visible = 2 };

    // Selects the light samples of punctual lights.
    static std::vector<size_t> columns(const LitScene& lit, const LitOptions& options) {
        std::vector<size_t> out;
        if (!options.shadows) return out;
        const std::vector<LightSample> lights = light_samples(lit, options);
        for (size_t k = 0; k < lights.size(); ++k)
            if (lit.lights[lights[k].light].is_punctual()) out.push_back(k);
        return out;
    }

    int width_;
    std::vector<size_t> columns_;
    PaddedImage<uint8_t> seen_;
};

// Records the texels that nearest lookups use.
class NearestTexels {
   public:
    NearestTexels(int width, int height, const LitScene& lit)
        : width_(width), lit_(lit), sources_(lit.meshes.size()), seen_(width, empty(lit) ? 0 : height, 1, Texels()) {
        for (size_t m = 0; m < lit.meshes.size(); ++m) sources_[m] = nearest(lit.meshes[m]);
    }

    static bool empty(const LitScene& lit) {
        return std::all_of(lit.meshes.begin(), lit.meshes.end(), [](const LitMesh& m) { return nearest(m).empty(); });
    }

    // Adds a point of a face.
    void add(int x, int y, int64_t face, const double* b) {
        const LitMesh& mesh = lit_.mesh_of(face);
        const int32_t number = int32_t(&mesh - lit_.meshes.data());
        if (sources_[number].empty()) return;
        const FacePoint<double> at{
            face - mesh.first_face, lit_.faces + 3 * face, mesh.first_vertex, {b[0], b[1], b[2]}};
        uint64_t value = 0;
        for (const Source* source : sources_[number]) {
            const Uv<double> uv = interpolated_uv(lit_.tables, *source, at);
            const Table& table = lit_.tables[source->value];
            const int64_t texel = footprint(*source, {uv.u, uv.v}).texel[0];
            for (int c = 0; c < table.width; ++c)
                value = hash(value, std::bit_cast<uint64_t>(table.at<double>(texel, c)));
        }
        Texels& here = *seen_.at(x, y);
        // If a pixel shows several meshes, the last one counts.
        here = {number, here.mesh == number && (here.several || here.value != value), value};
    }

    // Marks such pixels in a row.
    void mark(int y, uint8_t* pixels) const {
        for (int x = 0; x < width_; ++x) {
            const Texels* around[8];
            int n = 0;
            for (int dy = -1; dy <= 1; ++dy)
                for (int dx = -1; dx <= 1; ++dx) {
                    const Texels* t = seen_.at(x + dx, y + dy);
                    if ((dx || dy) && t->mesh >= 0) around[n++] = t;
                }
            for (int i = 0; i < n && !pixels[x]; ++i) {
                pixels[x] |= around[i]->several;
                for (int k = 0; k < i; ++k)
                    pixels[x] |= around[k]->mesh == around[i]->mesh && around[k]->value != around[i]->value;
            }
        }
    }

   private:
    struct Texels {
        int32_t mesh = -1;
        bool several = false;  // Points in the pixel see different texels.
        uint64_t value = 0;    // hash
    };

    static std::vector<const Source*> nearest(const LitMesh& mesh) {
        std::vector<const Source*> out;
        for (const Source* s :
             {&mesh.color, &mesh.base, &mesh.metallic, &mesh.roughness, &mesh.emission, &mesh.normal.map})
            if (s->exists() && s->kind == Source::Kind::texture && s->sampler.filter == TextureFilter::nearest)
                out.push_back(s);
        return out;
    }

    int width_;
    const LitScene& lit_;
    std::vector<std::vector<const Source*>> sources_;  // Each mesh has a list.
    PaddedImage<Texels> seen_;
};

// Records which pixels show emitters.
class SeenEmitters {
   public:
    SeenEmitters(int width, int height, const LitScene& lit, const LitOptions& options)
        : width_(width), lit_(lit), seen_(width, is_empty(lit, options) ? 0 : height, 1, 0) {}

    static bool is_empty(const LitScene& lit, const LitOptions& options) {
        return options.bounces == 1 || std::none_of(lit.meshes.begin(), lit.meshes.end(),
                                                    [](const LitMesh& mesh) { return mesh.emission.exists(); });
    }

    // Adds a point of a face.
    void add(int x, int y, int64_t face) { *seen_.at(x, y) |= lit_.mesh_of(face).emission.exists() ? emits : dark; }

    // Marks such pixels in a row. The background counts as dark.
    void mark(int y, uint8_t* pixels) const {
        for (int x = 0; x < width_; ++x) {
            uint8_t around = 0;
            for (int dy = -1; dy <= 1; ++dy)
                for (int dx = -1; dx <= 1; ++dx)
                    if (dx || dy) around |= *seen_.at(x + dx, y + dy) ? *seen_.at(x + dx, y + dy) : dark;
            if (around == (emits | dark)) pixels[x] = 1;
        }
    }

   private:
    enum : uint8_t { dark = 1, emits = 2 };

    int width_;
    const LitScene& lit_;
    PaddedImage<uint8_t> seen_;
};

class DiscontinuousPixels {
   public:
    DiscontinuousPixels(int width, int height, const LitScene& lit, const LitOptions& options)
        : width_(width),
          height_(height),
          paths_(options.bounces > 1),
          points_(size_t(width) * size_t(height), 0),
          lights_(width, height, lit, options),
          texels_(width, height, lit),
          has_texels_(!NearestTexels::empty(lit)),
          emitters_(width, height, lit, options),
          has_emitters_(!SeenEmitters::is_empty(lit, options)) {}

    // Adds a point that was shaded, and the visibility of its light samples.
    void add(int32_t pixel, int32_t face, const double* b, const int8_t* seen) {
        ++points_[pixel];
        lights_.add(pixel % width_, pixel / width_, seen);
        if (has_texels_) texels_.add(pixel % width_, pixel / width_, face, b);
        if (has_emitters_) emitters_.add(pixel % width_, pixel / width_, face);
    }

    // Marks the pixels. Returns by which factor to increase the points of each face in them, 0: none are marked.
    int find(std::vector<uint8_t>& pixels, ThreadTeam& team) const {
        pixels.assign(points_.size(), 0);
        if (lights_.empty() && !has_texels_ && !has_emitters_) return 0;
        team.parallel_for(height_, [&](int64_t y) {
            if (!lights_.empty()) lights_.mark(int(y), &pixels[y * width_]);
            if (has_texels_) texels_.mark(int(y), &pixels[y * width_]);
            if (has_emitters_) emitters_.mark(int(y), &pixels[y * width_]);
        });
        int64_t first = 0, there = 0;
        for (size_t i = 0; i < pixels.size(); ++i) first += points_[i], there += pixels[i] ? points_[i] : 0;
        if (std::none_of(pixels.begin(), pixels.end(), [](uint8_t p) { return p != 0; })) return 0;
        if (paths_) return points_again;
        return int(std::clamp<int64_t>(share_again * first / std::max<int64_t>(there, 1), 2, most_again));
    }

   private:
    int width_, height_;
    bool paths_;
    std::vector<int32_t> points_;
    LightVisibility lights_;
    NearestTexels texels_;
    bool has_texels_;
    SeenEmitters emitters_;
    bool has_emitters_;
};

}  // namespace edgegrad
