#include "track/texture.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

using Settings = TrackSettings;

constexpr double least_cosine = 0.3;      // of a point's normal to the viewer: texture is distorted at grazing angles
constexpr double border = 4;              // px from the image's border
constexpr float saturated = 0.95f;        // linear radiance from which a sensor may clip
constexpr double least_deviation = 0.01;  // linear radiance
constexpr double tukey = 4;               // deviations
// The light's harmonics have a normal prior of so much of the data's information, a hundredth of that for the constant
// one.
constexpr double light_prior = 0.003, constant_prior = 0.01;
constexpr double pixel_blur = 0.9;  // deviation of a pixel and of the lens, in pixels of the level

}  // namespace

void harmonics(Vec3 n, float out[9]) {
    out[0] = 1, out[1] = float(n.x), out[2] = float(n.y), out[3] = float(n.z);
    out[4] = float(n.x * n.y), out[5] = float(n.y * n.z), out[6] = float(n.z * n.x);
    out[7] = float(n.x * n.x - n.y * n.y), out[8] = float(1.5 * n.z * n.z - 0.5);
}

double choose_visible_points(const SurfacePoints& points, const Visibility& visibility, int object, RayBatch& batch,
                             std::vector<int32_t>& chosen) {
    const TrackCamera& camera = visibility.camera();
    const PosedMesh& o = visibility.objects()[object];
    // Points are visible where nothing lies before them; the surface itself does, by the rounding of floats.
    const double before = Settings::surface_depth * o.mesh->size();
    chosen.clear();
    for (int k = 0; k < points.size() && int(chosen.size()) < Settings::points; ++k) {
        const Vec3 q = o.pose(points.X[k]), d = camera.perspective() ? q : Vec3{0, 0, 1};
        if (!(-dot(o.pose.R * points.normal[k], d) > least_cosine * length(d))) continue;
        if (const auto x = camera.position(q); x && camera.contains(*x, border)) chosen.push_back(k);
    }
    std::sort(chosen.begin(), chosen.end(), [&](int32_t i, int32_t j) { return points.rank[i] < points.rank[j]; });
    size_t kept = 0, shown = 0;
    for (size_t first = 0; first < chosen.size(); first += RayBatch::size) {
        const int n = int(std::min<size_t>(RayBatch::size, chosen.size() - first));
        Ray rays[RayBatch::size];
        uint8_t own[RayBatch::size] = {}, covered[RayBatch::size] = {};
        for (int i = 0; i < n; ++i) {
            rays[i] = visibility.ray_to(o.pose(points.X[chosen[first + i]]));
            rays[i].end = 1 - before / length(rays[i].direction);
        }
        visibility.test(batch, object, rays, n, own);
        visibility.test_others(batch, object, rays, n, covered);
        for (int i = 0; i < n; ++i) {
            shown += !own[i];
            if (!own[i] && !covered[i]) chosen[kept++] = chosen[first + i];
        }
    }
    chosen.resize(kept);
    return shown ? double(kept) / double(shown) : 0;
}

TextureTerm::TextureTerm(const TrackedMesh& mesh) : points_(mesh.textured) {
    chosen_.reserve(Settings::points), row_.resize(size_t(Settings::points) * 3 * width);
    weight_.resize(Settings::points), residual_.reserve(3 * size_t(Settings::points)), usable_.resize(Settings::points);
}

void TextureTerm::choose_visible(const Visibility& visibility, int object) {
    visible_share_ = choose_visible_points(points_, visibility, object, batch_, chosen_);
}

void TextureTerm::read_points(const Frame& frame, int level, const TrackCamera& camera, const PosedMesh& object) {
    const float unit = float(1 << level);
    const int N = points_.size();
    for (size_t i = 0; i < chosen_.size(); ++i) {
        const int32_t k = chosen_[i];
        const Vec3 arm = object.pose.R * points_.X[k];
        const auto seen = camera.project(arm + object.pose.c);
        usable_[i] = seen.has_value();
        if (!seen) continue;
        double jx[6], jy[6];
        step_gradient(arm, object.mesh->size(), seen->dx, jx);
        step_gradient(arm, object.mesh->size(), seen->dy, jy);
        const float u = float(seen->x.x) / unit - 0.5f, v = float(seen->x.y) / unit - 0.5f;
        float I[4], right[4], left[4], down[4], up[4];
        frame.sample_texel(level, u, v, I);
        frame.sample_texel(level, u + 0.5f, v, right), frame.sample_texel(level, u - 0.5f, v, left);
        frame.sample_texel(level, u, v + 0.5f, down), frame.sample_texel(level, u, v - 0.5f, up);
        // The texture's blur that a pixel has: its size in texels.
        const double pixels = std::sqrt(std::sqrt(dot(seen->dx, seen->dx) * dot(seen->dy, seen->dy)));
        const double blur = std::log2(pixel_blur * unit * points_.texels[k] / pixels);
        const float at = float(std::clamp(blur, 0.0, points_.levels - 1.001));
        const int low = int(at), high = std::min(low + 1, points_.levels - 1);
        const float share = at - float(low);
        const float *T = &points_.colors[3 * (int64_t(low) * N + k)], *U = &points_.colors[3 * (int64_t(high) * N + k)];
        float L[9];
        harmonics(object.pose.R * points_.normal[k], L);
        for (int c = 0; c < 3; ++c) {
            float* row = &row_[(3 * i + c) * width];
            const float albedo = T[c] + share * (U[c] - T[c]);
            for (int a = 0; a < 9; ++a) row[a] = albedo * L[a];
            const float sx = (right[c] - left[c]) / unit, sy = (down[c] - up[c]) / unit;
            for (int a = 0; a < 6; ++a) row[9 + a] = sx * float(jx[a]) + sy * float(jy[a]);
            row[15] = I[c];
            if (I[c] >= saturated) usable_[i] = 0;
        }
    }
}

// Weighs points by their residuals under the present light.
void TextureTerm::weigh() {
    const int n = int(chosen_.size());
    if (!light.known) {
        for (int i = 0; i < n; ++i) weight_[i] = usable_[i];
        return;
    }
    float harmonic[3][9];
    for (int c = 0; c < 3; ++c)
        for (int a = 0; a < 9; ++a) harmonic[c][a] = float(light.harmonics[c][a]);
    residual_.clear();
    for (int i = 0; i < n; ++i) {
        float most = 0;
        for (int c = 0; c < 3; ++c) {
            const float* row = &row_[(3 * i + c) * width];
            float r = -row[15];
            for (int a = 0; a < 9; ++a) r += row[a] * harmonic[c][a];
            r = std::fabs(r), most = std::max(most, r);
            if (usable_[i]) residual_.push_back(r);
        }
        weight_[i] = most;
    }
    double deviation = 1;
    if (!residual_.empty()) {
        const auto middle = residual_.begin() + residual_.size() / 2;
        std::nth_element(residual_.begin(), middle, residual_.end());
        deviation = 1.48 * *middle;
    }
    deviation = std::min(std::max(deviation, least_deviation), 1.5 * light.deviation);
    int explained = 0;
    const float limit = float(tukey * deviation);
    for (int i = 0; i < n; ++i) {
        const float r = weight_[i] / limit, t = 1 - r * r;
        weight_[i] = usable_[i] && t > 0 ? t * t : 0;
        explained += weight_[i] > 0;
    }
    explained_ = n ? double(explained) / n : 0;
    light.deviation = std::min(deviation, 1.05 * light.deviation);
}

// Sums w z z^T over the rows z of a channel, for entries [a][b] with a in [first, first + 8) and b < width. Two rows of
// the sums stay in registers meanwhile, which takes a quarter of the time of the outer products one after the other.
template <int first, int columns>
[[gnu::always_inline]] inline void sum_rows(const float* rows, const float* weight, int n, double (&M)[16][16]) {
    for (int a = first; a < first + 8; a += 2) {
        double p[columns] = {}, q[columns] = {};
        for (int i = 0; i < n; ++i) {
            const float* z = rows + 48 * i;
            const double x = double(weight[i]) * z[a], y = double(weight[i]) * z[a + 1];
            for (int b = 0; b < columns; ++b) p[b] += x * z[b];
            for (int b = 0; b < columns; ++b) q[b] += y * z[b];
        }
        for (int b = 0; b < columns; ++b) M[a][b] = p[b], M[a + 1][b] = q[b];
    }
}
// Fills the lower triangle.
EDGEGRAD_VECTORIZED static void sum_lower(const float* rows, const float* weight, int n, double (&M)[16][16]) {
    sum_rows<0, 8>(rows, weight, n, M);
    sum_rows<8, 16>(rows, weight, n, M);
}

// Projects the light out of the sums of a channel: H = J^T J - B^T C^-1 B and g = J^T r with the light's residual r.
void TextureTerm::add(const Frame& frame, int level, const TrackCamera& camera, const PosedMesh& object,
                      NormalEquations& to) {
    if (chosen_.empty()) return;
    read_points(frame, level, camera, object);
    const int rounds = light.known ? 1 : 4;  // the light, and weights about it
    for (int round = 0; round < rounds; ++round) {
        weigh();
        // Channels share what the model does not explain, so that three count as one.
        const double information = 1 / (3 * light.deviation * light.deviation);
        for (int c = 0; c < 3; ++c) {
            double M[width][width] = {};
            sum_lower(&row_[c * width], weight_.data(), int(chosen_.size()), M);
            double C[9][9], trace = 0;
            for (int a = 0; a < 9; ++a) trace += M[a][a];
            if (!(trace > 0)) continue;
            for (int a = 0; a < 9; ++a)
                for (int b = 0; b <= a; ++b)
                    C[a][b] = M[a][b] + (a == b ? light_prior * trace * (a ? 1.0 : constant_prior) : 0.0);
            if (!factor(C)) continue;
            double* L = light.harmonics[c];
            for (int a = 0; a < 9; ++a) L[a] = M[15][a];
            solve_factored(C, L);
            if (round + 1 < rounds) continue;
            for (int k = 0; k < 6; ++k) {
                double B[9], g = -M[15][9 + k];
                for (int a = 0; a < 9; ++a) B[a] = M[9 + k][a], g += B[a] * L[a];
                to.g[k] += information * g;
                solve_factored(C, B);
                for (int m = 0; m <= k; ++m) {
                    double h = M[9 + k][9 + m];
                    for (int a = 0; a < 9; ++a) h -= B[a] * M[9 + m][a];
                    to.H[k][m] += information * h;
                }
            }
        }
        light.known = true;
    }
}

}  // namespace edgegrad
