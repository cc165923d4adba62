#include "interior/surface_measure.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "camera/polygon.h"
#include "core/sampler.h"
#include "estimator/default_samples.h"
#include "estimator/vertex_image.h"
#include "interior/control.h"
#include "interior/face_lanes.h"
#include "interior/pixel_mask.h"
#include "shading/shade.h"

namespace edgegrad {

namespace {

// These factors apply to the density of a triangle behind the hits (occlusion.h): without hit neighbours, and next to a
// hit face. They are never zero, because the triangle may still be visible.
constexpr OcclusionHint::HiddenFactor occluded_face{.rays = 2, .share = 1.0 / 64, .least = 1.0 / 64};
constexpr double occluded_near_hits = 1.0 / 8;

// Default samples are per unit of (area + longest side · 1 px), for interpolated colours and for textures, at the usual
// samples of the image (default_samples.h). They are chosen with those at edges: a smaller error of either would cost
// the same time (docs/tried.md).
constexpr double colored = 0.5, textured = 4;

// Under indirect light a sample has one noisy path. It costs about as much as a sample on a secondary edge, and there
// are as many of both (secondary/estimator.h).
constexpr double more_if_indirect = 4;

// A lit sample costs several times as much, so textures get no more lit samples than colours. On faces that are no
// slivers they are better placed in pixels, one in each, because neighbours' samples complement one another (sobol.h).
// A sliver is hit there by chance, and its samples weigh more.
constexpr double lit_pixel = 1, least_lit_area = 2,
                 sliver = 0.1;  // samples; px²; fraction of the longest side's square

// An adjoint as rough as noise changes from pixel to pixel within a face. Up to this factor more samples are taken, on
// faces several pixels long.
constexpr double most_for_noise = 4;
double more_if_rough(double rough, double longest) {
    return std::clamp(rough, 1.0, std::clamp(longest / 2, 1.0, most_for_noise));
}

// From this area in the image on, px², a triangle with a texture, or under a rough adjoint, is left to pixel samples.
// Each triangle's integral is estimated in exactly one way, chosen before any sample, so the sum is unbiased.
constexpr double least_area_by_pixels = 256;

// A face with a control gets fewer samples where the control is likely good: the adjoint changes little, and the face
// is not wide, px. From `widest_controlled` on its corners predict little.
constexpr double least_controlled = 1.0 / 16, wide_controlled = 32, widest_controlled = 64;

// Hit neighbours imply that a face is visible, unless this many rays should have hit it and none did. Samples would
// have to cancel all that the control of a hidden face adds.
constexpr double most_unhit = 4;

// A face this long, px, has each of its points within OcclusionHint::reach of a corner. A point of a triangle is at
// most two thirds of the longest side away from the nearest corner.
constexpr double longest_near_corners = 1.5 * OcclusionHint::reach;
static_assert(longest_near_corners < 2 * OcclusionHint::tile);

// Returns the factor on default samples.
template <class T>
double growth_of(const BackwardView<T>& view) {
    return sample_growth(view.image.spp) * (view.options.indirect ? more_if_indirect : 1);
}

// MeasuredChunk measures the faces of one chunk.
template <class T>
class MeasuredChunk {
   public:
    MeasuredChunk(const BackwardView<T>& view, const std::vector<double>& importance_around, bool geometry,
                  const GradientSink& to, Array<int8_t>& facing, SurfaceMeasure<T>& out, PixelMask& mask,
                  LocalGradients& grad)
        : view_(view),
          importance_around_(importance_around),
          want_places_(geometry),
          to_(to),
          facing_(facing),
          want_facing_(!facing.empty()),
          out_(out),
          mask_(mask),
          grad_(grad),
          C_(view.scene.channels),
          rough_(2 * view.importance.roughness() * view.importance.roughness()),
          want_values_(to.colors || to.vertex_attributes || to.face_attributes) {}

    double total() const { return total_; }
    double of_pixels() const { return of_pixels_; }

    void add(int64_t first, int64_t last) {
        for (int64_t g = first; g < last; g += FaceLanes::size) {
            add_hidden(g, std::min(g + FaceLanes::size, last), last);
            if (n_others_ == 0) continue;
            if (!lanes_) lanes_.emplace(C_);
            lanes_->count = 0;
            for (int i = 0; i < n_others_; ++i) gather(others_[i]);
            lay_out_lanes();
        }
    }

   private:
    // Lays out the small faces that lie behind all hits around their corners. They may be many and get few samples, so
    // their measure is cheap. The others are listed.
    void add_hidden(int64_t first, int64_t last, int64_t end) {
        const VertexView& p = view_.vertices;
        const ImageHits& hits = *view_.hits;
        const Vec2* x = p.x.data();
        HiddenFaces& l = hidden_;
        int count = 0;
        n_others_ = 0;
        std::fill(&out_.of_face[first], &out_.of_face[first] + (last - first), 0.0);
        std::fill(&out_.is_controlled[first], &out_.is_controlled[first] + (last - first), uint8_t(0));
        for (int64_t f = first; f < last; ++f) {
            const int32_t* v = view_.scene.faces + 3 * f;
            if (f + ahead < end)
                for (int i = 0; i < 3; ++i) prefetch(x + v[3 * ahead + i]), hits.prefetch(v[3 * ahead + i]);
            if (hits.are_behind(v)) {
                l.face[count] = f;
                for (int k = 0; k < 3; ++k) l.x[k][count] = x[v[k]].x, l.y[k][count] = x[v[k]].y;
                ++count;
                continue;
            }
            others_[n_others_++] = f;
            for (int i = 0; i < 3; ++i)
                prefetch(&p.outcode[v[i]]), prefetch(&p.q[v[i]]), prefetch(&view_.vertex_adjoint[int64_t(v[i]) * C_]);
        }
        if (!count) return;
        l.bound(view_.occlusion, rounding_);
        int8_t* facing = facing_.data();
        for (int i = 0; i < count; ++i) {
            const int64_t f = l.face[i];
            if (!(l.side[i] <= longest_near_corners)) {
                others_[n_others_++] = f;
                continue;
            }
            if (l.facing[i] == 0) [[unlikely]] {
                set_facing(f, l.wedge[i], l.side[i]);
                if (l.wedge[i] == 0) continue;
            } else if (want_facing_) {
                facing[f] = int8_t(l.facing[i]);
            }
            const double importance = importance_around_[l.tile[i]];
            if (!(importance > 0)) continue;
            const double m = l.extent[i] * rate(f) * hidden_by_all_around_;
            out_.of_face[f] = m * importance;
            total_ += m;
        }
    }

    // Puts a face inside the view of a pinhole into the lanes, and lays out any other.
    void gather(int64_t f) {
        const int32_t* v = view_.scene.faces + 3 * f;
        const VertexView& p = view_.vertices;
        if ((p.outcode[v[0]] | p.outcode[v[1]] | p.outcode[v[2]]) || !view_.camera.is_undistorted()) {
            set_facing(f, 0, 0);
            if (!polygon_.set(view_.camera, view_.volume, p, v)) return;
            const auto [low, high] = view_.camera.image_box(polygon_.low, polygon_.high);
            const double importance = view_.importance.mean(low, high);
            const double stretch = view_.camera.stretch(polygon_.low, polygon_.high);
            const Extent extent{polygon_.area * stretch, polygon_.longest * stretch, low, high, polygon_.nearest};
            const double m = default_samples(f, extent, view_.hits->of(v), [&] { return side_of(view_, f); });
            if (importance > 0) lay_out(f, m, importance, extent);
            return;
        }
        const int i = lanes_->count++;
        lanes_->face[i] = f;
        for (int k = 0; k < 3; ++k) {
            const Vec2 x = p.x[v[k]];
            lanes_->x[k][i] = x.x, lanes_->y[k][i] = x.y, lanes_->z[k][i] = p.q[v[k]].z;
        }
    }

    // Sets the orientation by `twice` the signed area in the image, px², unless its rounding decides. `side` is the
    // approximate length of the face, px.
    void set_facing(int64_t f, double twice, double side) {
        if (!want_facing_) return;
        if (std::fabs(twice) > rounding_ * side) [[likely]] {
            facing_[f] = twice > 0 ? 1 : -1;
            return;
        }
        const auto q = corners_of(view_, f);
        facing_[f] = int8_t(view_.camera.facing(q[0], q[1], q[2]));
    }

    // Returns the samples per unit of a face.
    double rate(int64_t f) const { return growth_ * (is_textured(view_.scene, f) ? textured : colored); }
    // Returns whether lights shade the face and it has a texture.
    bool is_detailed(int64_t f) const { return view_.detailed && view_.detailed[f]; }

    // Returns the factor on the measure of a face that lies behind the hits in `pixels` pixels.
    double hidden(int64_t pixels) const { return view_.occlusion.factor(occluded_face, pixels, view_.image.spp); }

    // Extent describes the image of a face.
    struct Extent {
        double area, longest;  // px², px
        Vec2 low, high;        // its box
        double nearest;        // depth
    };

    // Returns the default samples of a face. side() returns the side from which the face would be visible.
    template <class Side>
    double default_samples(int64_t f, const Extent& e, ImageHits::FaceHits hits, Side side) const {
        const double m = (e.area + e.longest) * rate(f), unhit = where_unhit(view_, f, e.area);
        const int64_t hiding = view_.seen[f] ? 0 : view_.occlusion.hiding_pixels(e.low, e.high, e.nearest);
        if (hits.partly)
            return m * std::min(hiding ? OcclusionHint::factor(occluded_near_hits, view_.image.spp) : 1, unhit);
        if (hiding) return m * hidden(hiding);
        return m * view_.hits->where_missed(view_.scene.faces[3 * f], side());
    }

    // Lays out a face without a control.
    void lay_out(int64_t f, double m, double importance, const Extent& e) {
        if (!std::isfinite(m)) return;  // Coordinates beyond 1e150 cannot be sampled.
        const bool textured = is_textured(view_.scene, f);
        if (!textured) m *= more_if_rough(rough_, e.longest);
        const bool by_pixels = is_detailed(f) ? e.area >= least_lit_area && e.area >= sliver * e.longest * e.longest
                                              : (textured || rough_ > 1) && e.area >= least_area_by_pixels;
        if (by_pixels) {
            out_.by_pixels[f] = 1;
            mask_.mark(e.low, e.high);
            of_pixels_ += m;
        } else {
            out_.of_face[f] = m * importance;
            total_ += m;
        }
    }

    // Lays out the faces in the lanes.
    void lay_out_lanes() {
        FaceLanes& l = *lanes_;
        if (!l.count) return;
        l.bound(view_.camera.width, view_.camera.height, view_.importance.radius());
        for (int i = 0; i < l.count; ++i) view_.importance.prefetch(l.i0[i], l.i1[i], l.j0[i], l.j1[i]);
        for (int i = 0; i < l.count; ++i) importance_[i] = view_.importance.mean(l.i0[i], l.i1[i], l.j0[i], l.j1[i]);
        bool any = false;
        for (int i = 0; i < l.count; ++i) {
            const int64_t f = l.face[i];
            const double area = 0.5 * std::fabs(l.wedge[i]);
            controlled_[i] = false;
            set_facing(f, l.wedge[i], l.longest[i]);
            if (!(area > 0) || !(importance_[i] > 0)) continue;
            const ImageHits::FaceHits seen = view_.hits->of(view_.scene.faces + 3 * f);
            const auto [x0, x1] = std::minmax({l.x[0][i], l.x[1][i], l.x[2][i]});
            const auto [y0, y1] = std::minmax({l.y[0][i], l.y[1][i], l.y[2][i]});
            const Extent extent{area, l.longest[i], {x0, y0}, {x1, y1}, std::min({l.z[0][i], l.z[1][i], l.z[2][i]})};
            samples_[i] =
                default_samples(f, extent, seen, [&] { return (l.wedge[i] > 0) == (view_.camera.k_det > 0) ? 1 : 2; });
            // The face gets a control if it has no texture and is so small that its corners predict its inside. A face
            // near the eye is not affine in the image.
            const bool is_hit = view_.seen[f] || view_.image.spp * area < most_unhit;
            if (is_hit && seen.whole && l.longest[i] <= widest_controlled && view_.options.controls &&
                !is_textured(view_.scene, f) && view_.camera.is_nearly_affine(l.depths[i])) {
                controlled_[i] = any = true;
                clear_[i] = seen.clear;
                gather_control(i);
            } else {
                lay_out(f, samples_[i], importance_[i], extent);
            }
        }
        if (any) add_controls();
    }

    void gather_control(int i) {
        const int C = C_;
        const int64_t f = lanes_->face[i];
        const int32_t* v = view_.scene.faces + 3 * f;
        constexpr int next = FaceLanes::size;
        double *adjoint = lanes_->adjoint.data() + i, *color = lanes_->color.data() + i;
        for (int k = 0; k < 3; ++k) {
            const T* A = &view_.vertex_adjoint[int64_t(v[k]) * C];
            for (int c = 0; c < C; ++c) adjoint[(7 * c + k) * next] = A[c];
        }
        for (int k = 0; k < 4; ++k) {
            const T* A =
                view_.adjoint.of(int64_t(lanes_->inside[1][k][i]) * view_.camera.width + lanes_->inside[0][k][i]);
            for (int c = 0; c < C; ++c) adjoint[(7 * c + 3 + k) * next] = A[c];
        }
        each_corner_value<0>(view_.scene, f, [&](int c, double c0, double c1, double c2) {
            color[2 * c * next] = c1 - c0;
            color[(2 * c + 1) * next] = c2 - c0;
        });
    }

    void add_controls() {
        const int C = C_, R = view_.scene.radiance;
        FaceLanes& l = *lanes_;
        l.integrate();
        for (int i = 0; i < l.count; ++i) {
            if (!controlled_[i]) continue;
            const int64_t f = l.face[i];
            const int32_t* v = view_.scene.faces + 3 * f;
            if (want_places_)
                for (int k = 0; k < 3; ++k) {
                    const Vec2 x_bar{l.x_bar[k][i], l.y_bar[k][i]};
                    grad_.x.template add<2>(v[k], &x_bar.x);
                }
            if (want_values_) {
                const auto T_of = [&](int c, int k) {
                    return 0.5 * std::fabs(l.wedge[i]) * l.T[(3 * c + k) * FaceLanes::size + i];
                };
                rows_.reset(view_.scene, f);
                for (int k = 0; k < 3; ++k) {
                    for (int c = 0; c < R; ++c) rows_.value[k * R + c] = T_of(c, k);
                    for (int c = R; c < C; ++c) rows_.attributes[k * (C - R) + c - R] = T_of(c, k);
                }
                rows_.add_to(view_.scene, f, to_, grad_);
            }
            double m = samples_[i];
            const double rough = 2 * variation(i);
            if (rough > 1) m *= more_if_rough(rough * rough, l.longest[i]);
            else if (clear_[i] && l.longest[i] < wide_controlled)
                m *= std::max({rough, l.longest[i] / wide_controlled, least_controlled});
            out_.is_controlled[f] = 1, out_.of_face[f] = m * importance_[i];
            total_ += m;
        }
    }

    // Returns the relative change of the adjoint over a face. It compares corners with each other, with pixels at the
    // middles of sides and face, and with its box's mean. Corners may agree by chance, as signs of an L1 loss do.
    double variation(int i) const {
        const FaceLanes& l = *lanes_;
        if (!(l.sum[i] > 0)) return 1;
        return std::max({l.change[i] / l.sum[i], l.apart[i] / l.sum[i],
                         std::fabs(1 - view_.importance.of(l.sum[i] / 3) / importance_[i])});
    }

    // Memory is prefetched this many faces ahead.
    static constexpr int ahead = 32;
    const BackwardView<T>& view_;
    const std::vector<double>& importance_around_;  // importance within two tiles of a point, by its tile
    const bool want_places_;
    const GradientSink& to_;
    Array<int8_t>& facing_;
    const bool want_facing_;
    SurfaceMeasure<T>& out_;
    PixelMask& mask_;
    LocalGradients& grad_;
    const int C_;
    const double rough_;  // for faces without a control
    const double growth_ = growth_of(view_);
    const double rounding_ = 16 * view_.camera.rounding_of_positions();  // rounding of a wedge, over the longer side
    double total_ = 0, of_pixels_ = 0;
    VisiblePolygon polygon_;
    std::optional<FaceLanes> lanes_;  // empty until there is a face for them
    HiddenFaces hidden_;
    int64_t others_[FaceLanes::size];
    int n_others_ = 0;
    const double hidden_by_all_around_ = hidden(OcclusionHint::pixels_around);
    double importance_[FaceLanes::size], samples_[FaceLanes::size];
    bool controlled_[FaceLanes::size], clear_[FaceLanes::size];
    const bool want_values_;
    CornerGrad rows_;
};

}  // namespace

template <class T>
SurfaceMeasure<T> measure_surface(const BackwardView<T>& view, bool geometry, Array<int8_t>& facing, GradientSink& to) {
    const GradientOptions& o = view.options;
    const int64_t F = view.scene.n_faces, chunks = (F + scatter_chunk - 1) / scatter_chunk;
    SurfaceMeasure<T> out{Array<double>(F), Array<uint8_t>(F), {}, {}};
    if (view.detailed || view.scene.face_texture || 2 * std::pow(view.importance.roughness(), 2) > 1)
        out.by_pixels.assign(F, 0);
    const double margin = view.image.filter.radius() - 0.5;
    if (view.detailed) out.beyond = int(std::ceil(margin));
    PixelMask mask(view.camera, margin, out.beyond);
    // x_bar sums the controls of all faces, by image positions of vertices.
    Array<double> x_bar = zeros(geometry ? 2 * view.scene.n_verts : 0, view.team);
    GradientSink whole;
    whole.x = geometry ? x_bar.data() : nullptr, whole.colors = to.colors;
    whole.vertex_attributes = to.vertex_attributes, whole.face_attributes = to.face_attributes;
    std::vector<double> total(chunks), of_pixels(chunks);
    const int columns = view.occlusion.columns(), rows = view.occlusion.rows();
    std::vector<double> importance_around(size_t(columns) * rows);
    view.team.parallel_for(rows, [&](int64_t j) {
        constexpr double tile = OcclusionHint::tile;
        for (int i = 0; i < columns; ++i)
            importance_around[j * columns + i] =
                view.importance.mean({(i - 2) * tile, (j - 2) * tile}, {(i + 3) * tile, (j + 3) * tile});
    });
    double seconds[2] = {};
    view.scatter.add(F, whole, seconds, [&](int64_t first, int64_t last, LocalGradients& grad) {
        MeasuredChunk<T> chunk(view, importance_around, geometry, to, facing, out, mask, grad);
        chunk.add(first, last);
        total[first / scatter_chunk] = chunk.total(), of_pixels[first / scatter_chunk] = chunk.of_pixels();
    });
    if (geometry) add_places(view, x_bar, to);
    for (int64_t k = 0; k < chunks; ++k) out.total += total[k], out.of_pixels += of_pixels[k];
    if (out.of_pixels > 0) out.pixels = mask.pixels();
    if (view.detailed) {
        const double each = out.scale(o.surface_samples) * growth_of(view) * lit_pixel;
        out.pixel_spp = int(std::clamp(std::round(each), 1.0, 0x1p20)), out.pixel_share = std::min(each, 1.0);
        thin_out(out.pixels, out.pixel_share, to_unit(seed_of(o.seed, Stream::surface_pixel_choice)));
    } else if (!out.pixels.empty()) {
        // Default samples are rounded at the usual samples of the image, so that they grow with these.
        const double growth = o.surface_samples >= 0 ? 1 : growth_of(view);
        const double each = out.scale(o.surface_samples) * out.of_pixels / double(out.pixels.size());
        out.pixel_spp = int(std::min(std::round(growth * std::max(std::round(each / growth), 1.0)), 0x1p20));
    }
    return out;
}

template SurfaceMeasure<float> measure_surface(const BackwardView<float>&, bool, Array<int8_t>&, GradientSink&);
template SurfaceMeasure<double> measure_surface(const BackwardView<double>&, bool, Array<int8_t>&, GradientSink&);

}  // namespace edgegrad
