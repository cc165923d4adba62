#include "raster/rasterize.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "raster/exact_sign.h"
#include "raster/sums.h"

namespace edgegrad {

namespace {

// Holds a triangle in one image.
struct Facet {
    Vec3 corner[3];     // components x, y, w
    double depth[3];    // z
    ImageLine side[3];  // opposite to the corners
    double facing;      // sign of the corners' determinant; 0: edge-on or degenerate

    template <class T>
    Facet(const Triangles<T>& mesh, int64_t item, int64_t triangle) {
        for (int i = 0; i < 3; ++i) {
            const int32_t v = mesh.tri[3 * triangle + i];
            corner[i] = mesh.in_image(item, v), depth[i] = double(mesh.vertex(item, v)[2]);
        }
        for (int i = 0; i < 3; ++i) side[i] = image_line(corner[(i + 1) % 3], corner[(i + 2) % 3]);
    }
    void orient() {
        const Vec3 a = corner[0];
        const double determinant = dot(side[0].n, a);
        const double doubt = side[0].doubt * (std::fabs(a.x) + std::fabs(a.y) + std::fabs(a.z));
        if (std::fabs(determinant) > doubt) facing = determinant > 0 ? 1 : -1;
        else facing = exact_sign(a, corner[1], corner[2]);
    }
};

// Bounds the pixels whose centres it may cover: [left, right) × [bottom, top).
struct Box {
    int64_t left, right, bottom, top;

    bool empty() const { return left >= right || bottom >= top; }
};

// Returns the box around the part of the triangle beyond the near plane, z ≥ −w. It has all pixels where that part
// reaches behind the eye.
Box box_of(const Facet& f, const Frames& frames) {
    constexpr double inf = std::numeric_limits<double>::infinity();
    double low[2] = {inf, inf}, high[2] = {-inf, -inf};
    bool unbounded = false;
    const auto add = [&](Vec3 p) {
        if (!(p.z > 0)) {
            unbounded = true;
            return;
        }
        const double place[2] = {p.x / p.z, p.y / p.z};
        for (int k = 0; k < 2; ++k) low[k] = std::min(low[k], place[k]), high[k] = std::max(high[k], place[k]);
    };
    double beyond[3];
    for (int i = 0; i < 3; ++i) beyond[i] = f.depth[i] + f.corner[i].z;
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        if (beyond[i] >= 0) add(f.corner[i]);
        if ((beyond[i] > 0 && beyond[j] < 0) || (beyond[i] < 0 && beyond[j] > 0)) {
            const double t = beyond[i] / (beyond[i] - beyond[j]);
            add(f.corner[i] + t * (f.corner[j] - f.corner[i]));
        }
    }
    if (unbounded) return {0, frames.width, 0, frames.height};
    if (!(low[0] <= high[0])) return {0, 0, 0, 0};
    // first() returns the first pixel whose centre is not left of x, with a margin for rounding.
    const auto first = [](double x, int64_t n) {
        return int64_t(std::clamp(std::ceil((x + 1) / 2 * double(n) - 0.501), 0.0, double(n)));
    };
    const auto end = [](double x, int64_t n) {
        return int64_t(std::clamp(std::floor((x + 1) / 2 * double(n) - 0.499) + 1, 0.0, double(n)));
    };
    return {first(low[0], frames.width), end(high[0], frames.width), first(low[1], frames.height),
            end(high[1], frames.height)};
}

// Holds the weights of a triangle's corners at a pixel centre that it covers.
struct Weights {
    double e[3];

    // Clamps the weights, because a centre covered by exact signs may lie a rounding outside.
    explicit Weights(const double (&signed_)[3]) {
        for (int i = 0; i < 3; ++i) e[i] = std::max(0.0, signed_[i]);
        if (!(sum() > 0)) std::fill_n(e, 3, 1.0);  // The triangle is so thin that nothing else is known.
    }
    double sum() const { return e[0] + e[1] + e[2]; }
    // Returns z / w, a mean of the corners'.
    double depth(const Facet& f) const {
        const double w = e[0] * f.corner[0].z + e[1] * f.corner[1].z + e[2] * f.corner[2].z;
        return (e[0] * f.depth[0] + e[1] * f.depth[1] + e[2] * f.depth[2]) / w;
    }
};

Weights weights_at(const Facet& f, double x, double y) {
    double e[3];
    for (int i = 0; i < 3; ++i) e[i] = f.facing * (f.side[i].n.x * x + (f.side[i].n.y * y + f.side[i].n.z));
    return Weights(e);
}

// Selects a rectangle of one image.
struct Window {
    int64_t item, row, end_row;
};

// Holds the nearest triangle at each pixel of a window, −1 where there is none, and its depth.
struct Nearest {
    std::vector<double> depth;
    std::vector<int32_t> triangle;

    void clear(int64_t pixels) {
        depth.assign(pixels, std::numeric_limits<double>::infinity());
        triangle.assign(pixels, -1);
    }
};

template <class T>
void find_nearest(const Triangles<T>& mesh, const Frames& frames, const Window& window, const T* behind, Nearest& out) {
    const int64_t W = frames.width;
    out.clear((window.end_row - window.row) * W);
    for (int64_t t = mesh.first(window.item); t < mesh.end(window.item); ++t) {
        Facet f(mesh, window.item, t);
        Box box = box_of(f, frames);
        box.bottom = std::max(box.bottom, window.row), box.top = std::min(box.top, window.end_row);
        if (box.empty()) continue;
        f.orient();
        if (f.facing == 0) continue;
        for (int64_t y = box.bottom; y < box.top; ++y) {
            const double py = frames.y(y);
            double start[3];
            for (int i = 0; i < 3; ++i) start[i] = f.side[i].n.y * py + f.side[i].n.z;
            for (int64_t x = box.left; x < box.right; ++x) {
                const double px = frames.x(x);
                double e[3];
                bool sure = true, outside = false;
                for (int i = 0; i < 3; ++i) {
                    e[i] = f.facing * (f.side[i].n.x * px + start[i]);
                    outside |= e[i]<-f.side[i].doubt, sure &= e[i]> f.side[i].doubt;
                }
                if (outside) continue;
                if (!sure) {
                    const Vec3 p = frames.exact_center(x, y);
                    for (int i = 0; i < 3 && !outside; ++i)
                        outside = side_of_line(p, f.corner[(i + 1) % 3], f.corner[(i + 2) % 3]) != f.facing;
                    if (outside) continue;
                }
                const double depth = Weights(e).depth(f);
                const int64_t at = (y - window.row) * W + x;
                if (!(depth < out.depth[at]) || !(depth >= -1 && depth <= 1)) continue;
                if (behind && !(T(depth) > behind[(window.item * frames.height + y) * W + x])) continue;
                out.depth[at] = depth, out.triangle[at] = int32_t(t);
            }
        }
    }
}

// Holds u and v at a pixel, their changes one pixel to the right and up, and intermediate results.
struct PixelBarycentrics {
    double sum, u, v;
    double dx, dy;  // size of a pixel
    double u_x, u_y, v_x, v_y;
    Vec3 total;  // sum of the sides' lines; its product with the centre is `sum`

    PixelBarycentrics(const Facet& f, const Weights& w, const Frames& frames)
        : sum(w.sum()), u(w.e[0] / sum), v(w.e[1] / sum), dx(2 / double(frames.width)), dy(2 / double(frames.height)) {
        total = f.facing * (f.side[0].n + f.side[1].n + f.side[2].n);
        const Vec3 a = f.facing * f.side[0].n, b = f.facing * f.side[1].n;
        u_x = dx * (a.x - u * total.x) / sum, u_y = dy * (a.y - u * total.y) / sum;
        v_x = dx * (b.x - v * total.x) / sum, v_y = dy * (b.y - v * total.y) / sum;
    }
};

}  // namespace

template <class T>
RasterImages<T> rasterize(const Triangles<T>& mesh, const Frames& frames, const T* behind, bool derivatives,
                          ThreadTeam& team) {
    RasterImages<T> out{Array<T>(4 * frames.pixels()), Array<T>(derivatives ? 4 * frames.pixels() : 0)};
    const int64_t H = frames.height, W = frames.width;
    // An image has several windows where there are fewer images than threads.
    const int64_t windows = std::clamp<int64_t>(2 * team.threads() / std::max<int64_t>(1, frames.count), 1, H);
    const auto scratch = [] { return std::make_unique<Nearest>(); };
    team.parallel_for_with_state(frames.count * windows, scratch, [&](Nearest& found, int64_t k) {
        const int64_t item = k / windows, part = k % windows;
        const Window window{item, part * H / windows, (part + 1) * H / windows};
        find_nearest(mesh, frames, window, behind, found);
        for (int64_t y = window.row; y < window.end_row; ++y)
            for (int64_t x = 0; x < W; ++x) {
                const int32_t t = found.triangle[(y - window.row) * W + x];
                const int64_t at = 4 * ((item * H + y) * W + x);
                if (t < 0) {
                    std::fill_n(out.rast.data() + at, 4, T(0));
                    if (derivatives) std::fill_n(out.rast_db.data() + at, 4, T(0));
                    continue;
                }
                Facet f(mesh, item, t);
                f.orient();
                const Weights w = weights_at(f, frames.x(x), frames.y(y));
                const PixelBarycentrics b(f, w, frames);
                T* to = out.rast.data() + at;
                to[0] = T(b.u), to[1] = T(b.v), to[2] = T(w.depth(f)), to[3] = T(t + 1);
                if (!derivatives) continue;
                T* db = out.rast_db.data() + at;
                db[0] = T(b.u_x), db[1] = T(b.u_y), db[2] = T(b.v_x), db[3] = T(b.v_y);
            }
    });
    return out;
}

template <class T>
Array<T> rasterize_vjp(const Triangles<T>& mesh, const Frames& frames, const T* rast, const T* rast_bar,
                       const T* db_bar, ThreadTeam& team) {
    const Targets to{mesh.vertices, 4, mesh.shared};
    const auto shares = shares_of_vertices(frames, mesh, to);
    return sums_over<T>(shares, frames, to, team, [&](const Share& share, double* sums) {
        share.each_row([&](int64_t item, int64_t y) {
            for (int64_t x = 0; x < frames.width; ++x) {
                const int64_t at = 4 * ((item * frames.height + y) * frames.width + x);
                const RasterPixel<T> seen(rast + at);
                if (seen.triangle < 0) continue;
                const T *bar = rast_bar + at, *d = db_bar ? db_bar + at : nullptr;
                if (bar[0] == 0 && bar[1] == 0 && (!d || (d[0] == 0 && d[1] == 0 && d[2] == 0 && d[3] == 0))) continue;
                Facet f(mesh, item, seen.triangle);
                f.orient();
                if (f.facing == 0) continue;  // The positions differ from those that were rasterized.
                const Vec3 p{frames.x(x), frames.y(y), 1};
                const PixelBarycentrics b(f, weights_at(f, p.x, p.y), frames);
                // u = e₀ / s and ∂u/∂X = dx (n₀.x − u N.x) / s, where s = p · N and N = n₀ + n₁ + n₂; v likewise.
                const double s = f.facing / b.sum;
                double u_bar = bar[0], v_bar = bar[1];
                Vec3 n_bar[3], total_bar;
                if (d) {
                    const double ux = b.dx * s * d[0], uy = b.dy * s * d[1], vx = b.dx * s * d[2], vy = b.dy * s * d[3];
                    n_bar[0] += Vec3{ux, uy, 0}, n_bar[1] += Vec3{vx, vy, 0};
                    total_bar = {-b.u * ux - b.v * vx, -b.u * uy - b.v * vy, 0};
                    u_bar += -f.facing * (ux * b.total.x + uy * b.total.y);
                    v_bar += -f.facing * (vx * b.total.x + vy * b.total.y);
                    const double scale = b.u_x * d[0] + b.u_y * d[1] + b.v_x * d[2] + b.v_y * d[3];
                    total_bar += -s * scale * p;
                }
                n_bar[0] += s * u_bar * p, n_bar[1] += s * v_bar * p;
                total_bar += -s * (u_bar * b.u + v_bar * b.v) * p;
                Vec3 corner_bar[3];
                for (int i = 0; i < 3; ++i) {
                    const int j = (i + 1) % 3, k = (i + 2) % 3;
                    cross_vjp(f.corner[j], f.corner[k], n_bar[i] + total_bar, corner_bar[j], corner_bar[k]);
                }
                for (int i = 0; i < 3; ++i) {
                    double* row = sums + 4 * (mesh.tri[3 * seen.triangle + i] - share.first_target);
                    row[0] += corner_bar[i].x, row[1] += corner_bar[i].y, row[3] += corner_bar[i].z;
                }
            }
        });
    });
}

#define EDGEGRAD_OF(T)                                                                                   \
    template RasterImages<T> rasterize(const Triangles<T>&, const Frames&, const T*, bool, ThreadTeam&); \
    template Array<T> rasterize_vjp(const Triangles<T>&, const Frames&, const T*, const T*, const T*, ThreadTeam&);
EDGEGRAD_OF(float)
EDGEGRAD_OF(double)

}  // namespace edgegrad
