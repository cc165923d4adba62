#include "python/curve_arrays.h"

#include "accumulate/curve_hits.h"
#include "python/shaped.h"
#include "python/unlocked.h"

namespace edgegrad {

nb::dict curve_arrays(const std::vector<CurveRecords>& parts, double least, bool one, int threads) {
    nb::dict curves;
    CurveHits hits = unlocked(threads, [&](ThreadTeam& team) { return curve_hits(parts, least, one, team); });
    curves["hit_sample"] = rows(std::move(hits.sample)), curves["hit_face"] = rows(std::move(hits.face));
    curves["hit_side"] = rows(std::move(hits.side)), curves["hit_b"] = rows(std::move(hits.b), {3});
    curves["hit_x"] = rows(std::move(hits.x), {2}), curves["hit_factor"] = rows(std::move(hits.factor));
    curves["to_background"] = rows(std::move(hits.to_background));
    const auto add = [&](const char* name, auto field, std::vector<size_t> row = {}) {
        curves[name] =
            rows(unlocked(threads, [&](ThreadTeam& team) { return joined(parts, field, team); }), std::move(row));
    };
    const auto add_rows = [&](const char* name, auto field) {
        curves[name] = rows(unlocked(threads, [&](ThreadTeam& team) { return joined_rows(parts, field, team); }));
    };
    using C = CurveRecords;
    add("x", &C::x, {2}), add("by_k", &C::by_k, {intrinsics_width});
    add_rows("row_of", &C::row_of), add("vertex", &C::vertex), add("by_q", &C::by_q, {3});
    add_rows("uv_row_of", &C::uv_row_of), add("uv", &C::uv), add("by_uv", &C::by_uv, {2});
    add_rows("alpha_row_of", &C::alpha_row_of), add("alpha", &C::alpha), add("by_alpha", &C::by_alpha);
    add_rows("transparent_row_of", &C::transparent_row_of), add("transparent", &C::transparent),
        add("transparent_b", &C::transparent_b, {2});
    add("light", &C::light), add("light_uv", &C::light_uv, {2}), add("by_light", &C::by_light, {3});
    return curves;
}

}  // namespace edgegrad
