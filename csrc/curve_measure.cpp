#include "curve_measure.h"

#include <algorithm>
#include <cmath>

#include "crease_control.h"

namespace edgegrad {

namespace {

// Default samples a pixel of curve; see surface_measure.cpp.
constexpr double samples_per_pixel = 24;

// What the measure of a silhouette and of a crease is multiplied by if it lies behind what the image hit (occlusion.h).
// Never zero, for it may be visible all the same. Of what was merely not hit, only creases get fewer samples: at the
// limb of a fine mesh the faces beside a silhouette are a hundredth of a pixel wide and hit by chance.
constexpr double occluded = 1.0 / 16, occluded_crease = 1.0 / 256;

// How far, in pixels, a ray may miss the points of a curve. A hundredth where it would be more: by then the image shows
// floats, not faces.
template <class T>
double reach_of_rays(const BackwardView<T>& view, const Curve& c) {
    double error = 0;
    const HalfEdge& h = c.minus.face >= 0 ? c.minus : c.plus;
    for (const int corner : {h.first(), h.second()}) {
        const double* p = view.scene.verts + 3 * int64_t(vertex(view.scene, h, corner));
        error = std::max(error, view.frame.error({p[0], p[1], p[2]}));
    }
    return std::max(c.rounding, std::min(view.camera.pixels_per_unit / std::min(c.w0, c.w1) * error, 0.01));
}

// Mean of Σ_c |L| over all colours: the size of a jump of which nothing is known.
template <class T>
double mean_radiance(const SceneView<T>& scene, Team& team) {
    std::vector<double> sum(Team::blocks(scene.n_colors), 0.0);
    team.each_block(scene.n_colors, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t i = first * scene.channels; i < last * scene.channels; ++i) sum[k] += std::fabs(scene.colors[i]);
    });
    double all = 0;
    for (const double s : sum) all += s;
    return scene.n_colors ? all / double(scene.n_colors) : 0;
}

// The curves of one chunk of edges.
template <int N, class T>
class MeasuredEdges {
   public:
    MeasuredEdges(const BackwardView<T>& view, const CurveFinder<T>& finder, double radiance, Array<double>& of_edge)
        : view_(view), finder_(finder), radiance_(radiance), of_edge_(of_edge), control_(view) {}

    CurvesFound found;
    std::vector<ImageSegment> segments;

    // `x`: where controls go; null if there are none.
    void add(int64_t first, int64_t last, RowBuffer* x) {
        for (int64_t e = first; e < last; ++e) {
            Curve c;
            of_edge_[e] = 0;
            if (!finder_.find(e, c)) continue;
            ++(c.is_crease() ? found.creases : found.silhouettes);
            const Vec2 low{std::min(c.x0.x, c.x1.x), std::min(c.x0.y, c.x1.y)};
            const Vec2 high{std::max(c.x0.x, c.x1.x), std::max(c.x0.y, c.x1.y)};
            const double importance = view_.importance.mean(low, high);
            if (!(importance > 0) || !std::isfinite(c.length)) continue;
            const double visible = visibility(c, low, high), m = c.length * visible * jump(c, low, high, x);
            of_edge_[e] = m * importance;
            found.pixels += m;
            segments.push_back({.edge = e,
                                .a = c.x0,
                                .b = c.x1,
                                .reach = reach_of_rays(view_, c),
                                .rounding = c.rounding,
                                .depth = nearest_depth(c)});
        }
    }

   private:
    static double nearest_depth(const Curve& c) {
        return std::min((1 - c.t0) * c.a.z + c.t0 * c.b.z, (1 - c.t1) * c.a.z + c.t1 * c.b.z);
    }

    double visibility(const Curve& c, Vec2 low, Vec2 high) const {
        if (view_.occlusion.hides(low, high, nearest_depth(c)))
            return OcclusionHint::factor(c.is_crease() ? occluded_crease : occluded, view_.options.spp);
        if (!c.is_crease() || !view_.hits) return 1;
        const auto hit = [&](int corner) { return view_.hits->at(vertex(view_.scene, c.minus, corner)); };
        if (hit(c.minus.first()) || hit(c.minus.second())) return 1;
        const int32_t vertex = view_.scene.faces[3 * int64_t(c.minus.face)];
        return view_.hits->where_missed(vertex, side_of(view_, c.minus.face));
    }

    // Relative to a jump of the size of the mean radiance, which is taken where nothing is known.
    double jump(const Curve& c, Vec2 low, Vec2 high, RowBuffer* x) {
        if (!joins_colors(view_.scene, c)) return 1;
        const CreaseColors<T> colors(view_.scene, c);
        const int C = view_.scene.channels;
        const double size = std::min(0.5 * (colors.size(0, C) + colors.size(1, C)) / radiance_, largest);
        if (!x || !control_.set(c)) return size;
        control_.add_integral();
        control_.flush(*x);
        return size * control_.density(low, high);
    }

    static constexpr double largest = 2;  // so that a bright face among dark ones does not take all samples
    const BackwardView<T>& view_;
    const CurveFinder<T>& finder_;
    const double radiance_;
    Array<double>& of_edge_;
    CreaseControl<N, T> control_;
};

}  // namespace

template <class T>
Curves<T>::Curves(const BackwardView<T>& view)
    : finder(view),
      of_edge(view.geometry.topology().n_edges()),
      x_bar(zeros(view.hits && finder.finds_creases() && !view.options.dry ? 2 * view.scene.n_verts : 0, view.team)) {}

template <class T>
int64_t Curves<T>::wanted(int64_t given) const {
    if (!(pixels > 0)) return 0;
    return given >= 0 ? given : int64_t(std::ceil(samples_per_pixel * pixels));
}

template <int N, class T>
Curves<T> measure_curves(const BackwardView<T>& view) {
    Curves<T> out(view);
    const int64_t E = out.of_edge.size();
    const double radiance = mean_radiance(view.scene, view.team);
    std::vector<CurvesFound> parts;
    const auto measure = [&](int64_t k, int64_t first, int64_t last, RowBuffer* x) {
        MeasuredEdges<N, T> part(view, out.finder, radiance, out.of_edge);
        part.add(first, last, x);
        parts[k] = part.found, out.segments[k] = std::move(part.segments);
    };
    const auto resize = [&](int64_t n) { parts.resize(n), out.segments.resize(n); };
    if (out.x_bar.empty()) {
        resize(Team::blocks(E));
        view.team.each_block(E, [&](int64_t k, int64_t first, int64_t last) { measure(k, first, last, nullptr); });
    } else {
        resize((E + scatter_chunk - 1) / scatter_chunk);
        Destination whole;
        whole.x = out.x_bar.data();
        double seconds[2] = {};
        view.scatter.add(E, whole, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
            measure(first / scatter_chunk, first, last, &grad.x);
        });
    }
    for (const CurvesFound& part : parts)
        out.pixels += part.pixels, out.silhouettes += part.silhouettes, out.creases += part.creases;
    return out;
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template Curves<float> measure_curves<N>(const BackwardView<float>&); \
    template Curves<double> measure_curves<N>(const BackwardView<double>&);
EDGEGRAD_FOR_CHANNELS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
template struct Curves<float>;
template struct Curves<double>;
// clang-format on

}  // namespace edgegrad
