#include "raster/antialias.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "raster/sums.h"

namespace edgegrad {

namespace {

// Holds a side of a triangle as a line n · p = 0 of the image.
struct SideLine {
    Vec3 a, b, n;  // components x, y, w

    template <class T>
    SideLine(const Triangles<T>& mesh, int64_t item, int64_t half_edge) {
        const int64_t t = half_edge / 3, i = half_edge % 3;
        a = mesh.in_image(item, mesh.tri[3 * t + (i + 1) % 3]), b = mesh.in_image(item, mesh.tri[3 * t + (i + 2) % 3]);
        n = cross(a, b);
    }
};

// Returns whether the surface folds over or ends at a side of a triangle; no other continues beyond it.
template <class T>
bool is_silhouette(const Triangles<T>& mesh, const EdgeGroups& edges, int64_t item, int64_t half_edge) {
    // It returns the corner opposite to a half-edge.
    const auto corner = [&](int64_t h) { return mesh.in_image(item, mesh.tri[h]); };
    const Vec3 n = SideLine(mesh, item, half_edge).n;
    const double own = dot(n, corner(half_edge));
    const int32_t group = edges.group[half_edge];
    for (int32_t k = edges.start[group]; k < edges.start[group + 1]; ++k) {
        const int64_t other = edges.member[k];
        if (other != half_edge && own * dot(n, corner(other)) < 0) return false;
    }
    return true;
}

// Returns a bit for each side of each triangle: (images, triangles). There is one image if all share their vertices.
template <class T>
std::vector<uint8_t> silhouettes(const Triangles<T>& mesh, const EdgeGroups& edges, int64_t images, ThreadTeam& team) {
    std::vector<uint8_t> out(images * mesh.triangles);
    team.parallel_for_blocks(int64_t(out.size()), [&](int64_t, int64_t first, int64_t last) {
        for (int64_t k = first; k < last; ++k)
            for (int i = 0; i < 3; ++i)
                out[k] |= uint8_t(is_silhouette(mesh, edges, k / mesh.triangles, 3 * (k % mesh.triangles) + i) << i);
    });
    return out;
}

// Holds two neighbours in the image, along x (axis 0) or y (axis 1).
struct Neighbours {
    int64_t column, row;  // near pixel
    int axis;
    int step;  // 1 means that the far one is to the right or above.

    Vec3 center(const Frames& frames) const { return {frames.x(column), frames.y(row), 1}; }
    double size(const Frames& frames) const { return 2 / double(axis == 0 ? frames.width : frames.height); }
};

// Returns where the line of a side crosses the line through two centres, as a fraction of the way from near to far.
// Returns none where the side does not reach it, is behind the eye, or is more parallel to it than across.
template <class T>
std::optional<double> share_at(const SideLine& side, const Neighbours& at, const Frames& frames) {
    const Vec3 p = at.center(frames);
    const double nx = side.n.x / double(frames.width), ny = side.n.y / double(frames.height);
    if (at.axis == 0 ? !(std::fabs(nx) >= std::fabs(ny)) : !(std::fabs(ny) > std::fabs(nx))) return {};
    const double fa = at.axis == 0 ? side.a.y - p.y * side.a.z : side.a.x - p.x * side.a.z,
                 fb = at.axis == 0 ? side.b.y - p.y * side.b.z : side.b.x - p.x * side.b.z;
    if ((fa < 0) == (fb < 0)) return {};
    const double t = fa / (fa - fb);
    if (!((1 - t) * side.a.z + t * side.b.z > 0)) return {};
    const double place =
        at.axis == 0 ? -(side.n.y * p.y + side.n.z) / side.n.x : -(side.n.x * p.x + side.n.z) / side.n.y;
    const double share = at.step * (place - (at.axis == 0 ? p.x : p.y)) / at.size(frames);
    if (!(share >= 0 && share <= 1)) return {};
    return share;
}

template <class T>
class SilhouetteFinder {
   public:
    SilhouetteFinder(const Triangles<T>& mesh, const Frames& frames, const uint8_t* silhouette, int64_t item,
                     const T* rast)
        : mesh_(mesh), frames_(frames), silhouette_(silhouette), item_(item), rast_(rast) {}

    // Handles the pixel and its neighbour to the right or above.
    void visit(int64_t column, int64_t row, int axis, std::vector<SilhouetteCrossing>& out) const {
        const int64_t here = (item_ * frames_.height + row) * frames_.width + column,
                      there = here + (axis == 0 ? 1 : frames_.width);
        const RasterPixel<T> p(rast_ + 4 * here), q(rast_ + 4 * there);
        if (p.triangle == q.triangle) return;
        const bool first = q.triangle < 0 || (p.triangle >= 0 && p.depth <= q.depth);
        const int64_t triangle = first ? p.triangle : q.triangle;
        const int sides = silhouette_[triangle];
        if (!sides) return;
        const Neighbours at{column + (!first && axis == 0), row + (!first && axis == 1), axis, first ? 1 : -1};
        for (int i = 0; i < 3; ++i) {
            if (!(sides >> i & 1)) continue;
            const SideLine side(mesh_, item_, 3 * triangle + i);
            if (const auto share = share_at<T>(side, at, frames_)) {
                out.push_back(
                    {first ? here : there, first ? there : here, int32_t(triangle), int8_t(i), int8_t(axis), *share});
                return;  // A triangle ends at one side.
            }
        }
    }

   private:
    const Triangles<T>& mesh_;
    const Frames& frames_;
    const uint8_t* silhouette_;  // (triangles,)
    const int64_t item_;
    const T* rast_;
};

// Selects the pixel that is blended, and the weight of the other.
struct Blend {
    int64_t to, from;
    double weight;

    explicit Blend(const SilhouetteCrossing& c) {
        if (c.share > 0.5) to = c.far, from = c.near, weight = c.share - 0.5;
        else to = c.near, from = c.far, weight = 0.5 - c.share;
    }
};

// Calls body(image, crossing) for the crossings of each image.
template <class Body>
void each_image(const std::vector<SilhouetteCrossing>& crossings, const Frames& frames, ThreadTeam& team, Body body) {
    const int64_t pixels = frames.height * frames.width;
    const auto begin = [&](int64_t image) {
        return std::partition_point(crossings.begin(), crossings.end(),
                                    [&](const SilhouetteCrossing& c) { return c.near < image * pixels; });
    };
    team.parallel_for(frames.count, [&](int64_t image) {
        const auto end = begin(image + 1);
        for (auto c = begin(image); c != end; ++c) body(image, *c);
    });
}

template <class T>
Array<T> copy_of(const T* values, int64_t n, ThreadTeam& team) {
    Array<T> out(n);
    team.parallel_for_blocks(
        n, [&](int64_t, int64_t first, int64_t last) { std::copy(values + first, values + last, out.data() + first); });
    return out;
}

}  // namespace

template <class T>
std::vector<SilhouetteCrossing> find_crossings(const Triangles<T>& mesh, const Frames& frames, const EdgeGroups& edges,
                                               const T* rast, ThreadTeam& team) {
    const std::vector<uint8_t> sides =
        silhouettes(mesh, edges, mesh.shared ? std::min<int64_t>(1, frames.count) : frames.count, team);
    // Bands of rows let threads end at the same time, and keep crossings in order.
    constexpr int64_t rows = 32;
    const int64_t H = frames.height, bands = (H + rows - 1) / rows;
    std::vector<std::vector<SilhouetteCrossing>> found(frames.count * bands);
    team.parallel_for(frames.count * bands, [&](int64_t k) {
        const int64_t item = k / bands, band = k % bands;
        const SilhouetteFinder<T> pairs(mesh, frames, sides.data() + (mesh.shared ? 0 : item * mesh.triangles), item,
                                        rast);
        // A local vector avoids cache conflicts between threads that write close to each other.
        std::vector<SilhouetteCrossing> own;
        for (int64_t y = band * rows; y < std::min(H, (band + 1) * rows); ++y)
            for (int64_t x = 0; x < frames.width; ++x) {
                if (x + 1 < frames.width) pairs.visit(x, y, 0, own);
                if (y + 1 < H) pairs.visit(x, y, 1, own);
            }
        found[k] = std::move(own);
    });
    std::vector<SilhouetteCrossing> out;
    for (const auto& own : found) out.insert(out.end(), own.begin(), own.end());
    return out;
}

template <class T>
Array<T> antialias(const std::vector<SilhouetteCrossing>& crossings, const Frames& frames, int channels, const T* color,
                   ThreadTeam& team) {
    Array<T> out = copy_of(color, frames.pixels() * channels, team);
    each_image(crossings, frames, team, [&](int64_t, const SilhouetteCrossing& c) {
        const Blend blend(c);
        const T *to = color + blend.to * channels, *from = color + blend.from * channels;
        for (int k = 0; k < channels; ++k)
            out[blend.to * channels + k] += T(blend.weight * (double(from[k]) - double(to[k])));
    });
    return out;
}

template <class T>
AntialiasGrad<T> antialias_vjp(const std::vector<SilhouetteCrossing>& crossings, const Triangles<T>& mesh,
                               const Frames& frames, int channels, const T* color, const T* bar, AntialiasWanted wanted,
                               ThreadTeam& team) {
    AntialiasGrad<T> out;
    if (wanted.color) {
        out.color = copy_of(bar, frames.pixels() * channels, team);
        each_image(crossings, frames, team, [&](int64_t, const SilhouetteCrossing& c) {
            const Blend blend(c);
            for (int k = 0; k < channels; ++k) {
                const T g = T(blend.weight * double(bar[blend.to * channels + k]));
                (*out.color)[blend.from * channels + k] += g, (*out.color)[blend.to * channels + k] -= g;
            }
        });
    }
    if (!wanted.pos) return out;
    const Targets to{mesh.vertices, 4, mesh.shared};
    // An image has few crossings, so it is one share.
    const std::vector<Share> shares = shares_of({frames.count, 1, 1}, to);
    const int64_t pixels = frames.height * frames.width;
    out.pos = sums_over<T>(shares, frames, to, team, [&](const Share& share, double* sums) {
        auto c = std::partition_point(crossings.begin(), crossings.end(),
                                      [&](const SilhouetteCrossing& k) { return k.near < share.item * pixels; });
        for (; c != crossings.end() && c->near < share.end_item * pixels; ++c) {
            // Both blends change by (near − far) for a change of the share.
            const int64_t blended = Blend(*c).to;
            double share_bar = 0;
            for (int k = 0; k < channels; ++k)
                share_bar += double(bar[blended * channels + k]) *
                             (double(color[c->near * channels + k]) - double(color[c->far * channels + k]));
            if (share_bar == 0) continue;
            const int64_t at = c->near % pixels, step = c->far - c->near;
            const int axis = c->axis;
            const Neighbours pair{at % frames.width, at / frames.width, axis, step > 0 ? 1 : -1};
            const SideLine side(mesh, c->near / pixels, 3 * int64_t(c->triangle) + c->side);
            // The point p* on the line n · p* = 0 moves along the axis by δx = −(δn · p*) / n.x, and likewise with y.
            Vec3 p = pair.center(frames);
            const double moved = pair.step * c->share * pair.size(frames);
            (axis == 0 ? p.x : p.y) += moved;
            const double scale = -pair.step * share_bar / (pair.size(frames) * (axis == 0 ? side.n.x : side.n.y));
            Vec3 a_bar, b_bar;
            cross_vjp(side.a, side.b, scale * p, a_bar, b_bar);
            const int32_t* corners = mesh.tri + 3 * int64_t(c->triangle);
            const auto add = [&](int32_t v, Vec3 g) {
                double* row = sums + 4 * int64_t(v);
                row[0] += g.x, row[1] += g.y, row[3] += g.z;
            };
            add(corners[(c->side + 1) % 3], a_bar), add(corners[(c->side + 2) % 3], b_bar);
        }
    });
    return out;
}

#define EDGEGRAD_OF(T)                                                                                              \
    template std::vector<SilhouetteCrossing> find_crossings(const Triangles<T>&, const Frames&, const EdgeGroups&,  \
                                                            const T*, ThreadTeam&);                                 \
    template Array<T> antialias(const std::vector<SilhouetteCrossing>&, const Frames&, int, const T*, ThreadTeam&); \
    template AntialiasGrad<T> antialias_vjp(const std::vector<SilhouetteCrossing>&, const Triangles<T>&,            \
                                            const Frames&, int, const T*, const T*, AntialiasWanted, ThreadTeam&);
EDGEGRAD_OF(float)
EDGEGRAD_OF(double)

}  // namespace edgegrad
