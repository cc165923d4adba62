#include "accumulate/scatter.h"

#include <utility>

namespace edgegrad {

// Pairs the rows of both with their width.
constexpr int as_radiance = 0, as_pixels = -1, as_vertex_attributes = -2, as_face_attributes = -3;
struct RowSlot {
    RowBuffer LocalGradients::* rows;
    double* GradientSink::* to;
    int width;
};

namespace {

constexpr RowSlot row_slots[] = {
    {&LocalGradients::q, &GradientSink::q, 3},
    {&LocalGradients::x, &GradientSink::x, 2},
    {&LocalGradients::colors, &GradientSink::colors, as_radiance},
    {&LocalGradients::uvs, &GradientSink::uvs, 2},
    {&LocalGradients::texels, &GradientSink::texels, as_radiance},
    {&LocalGradients::alphas, &GradientSink::alphas, 1},
    {&LocalGradients::vertex_attributes, &GradientSink::vertex_attributes, as_vertex_attributes},
    {&LocalGradients::face_attributes, &GradientSink::face_attributes, as_face_attributes},
    {&LocalGradients::pixels, &GradientSink::pixels, as_pixels}};

}  // namespace

int64_t RowBuffer::bytes(const Load& load, int threads) {
    const int64_t chunks = std::min((load.samples + scatter_chunk - 1) / scatter_chunk, chunks_in_flight * threads);
    const int64_t samples = std::min(load.samples, scatter_chunk * chunks), owners = std::min(threads, most_owners);
    // Samples come in order, so runs are at most as many as primitives and ends of chunks.
    const int64_t runs = load.primitives < 0 ? samples : std::min(samples, load.primitives + chunks);
    const int64_t used = std::min<int64_t>(owners, (load.destinations + run - 1) / run);
    const int64_t rows = std::max(load.each * runs, chunks * used * int64_t(fewest_rows));
    return rows * int64_t(sizeof(int64_t) + sizeof(double) * load.width) +
           chunks * (owners * int64_t(sizeof(Rows)) + n_recent * int64_t(sizeof(Recent)));
}

void Scatter::add(int64_t n, GradientSink& to, double (&seconds)[2], const Body& body) {
    scatter_in_waves(
        team_, n, grads_, [&](LocalGradients& g, int owners) { prepare(g, to, owners); }, body,
        [&](const LocalGradients& g, int owner) {
            for (const RowSlot& slot : row_slots)
                if (double* const there = to.*slot.to) (g.*slot.rows).add_to(there, owner);
        },
        [&](LocalGradients& g) {
            to.k += g.k;
            if (!to.records) return;
            to.records->surface.push_back(std::exchange(g.records.surface, {}));
            to.records->curves.push_back(std::exchange(g.records.curves, {}));
        },
        seconds);
}

// Empties a chunk's buffers, and makes those that are wanted.
void Scatter::prepare(LocalGradients& g, const GradientSink& to, int owners) const {
    for (const RowSlot& slot : row_slots) {
        RowBuffer& rows = g.*slot.rows;
        const int width = width_of(slot, to);
        if (to.*slot.to) rows.prepare(width, owners);
        rows.clear();
    }
    g.k = {};
}

int Scatter::width_of(const RowSlot& slot, const GradientSink& to) const {
    switch (slot.width) {
        case as_radiance:
            return widths_.radiance;
        case as_pixels:
            return to.pixel_width;
        case as_vertex_attributes:
            return widths_.vertex_attributes;
        case as_face_attributes:
            return widths_.face_attributes;
        default:
            return slot.width;
    }
}

}  // namespace edgegrad
