#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/beside.hpp"

namespace stillmap::border {
namespace {

// (E, 2) first and last look
using Spans = nb::ndarray<int32_t, nb::numpy, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

template <int D>
Span* of_elements(const Surface<D>& surface, const Spans& spans) {
  require(surface.fitted(), "surface: fit it first");
  require(spans.shape(0) == surface.size(), "spans: expected one per element");
  static_assert(sizeof(Span) == 2 * sizeof(int32_t));
  return reinterpret_cast<Span*>(spans.data());
}

template <int D>
void widen(const Surface<D>& surface, const Points<D>& points, const Flat<bool>& hit,
           const Flat<int64_t>& offset, const Poses<D>& poses, const Flat<int64_t>& look,
           const Spans& spans) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  require(look.shape(0) == scans.n_scans, "look: expected one number per scan");
  for (size_t t = 0; t < scans.n_scans; ++t)
    require(look.data()[t] >= 0 && look.data()[t] <= kLastLook, "look: out of range");
  Span* widened = of_elements(surface, spans);
  nb::gil_scoped_release released;
  widen_spans<D>(surface, scans, look.data(), widened);
}

BesideOptions checked(double radius, double coplanar, double for_static, double for_dynamic,
                      double least, double most, double moved, int rounds) {
  require(radius >= 1.0 && radius <= 8.0, "radius: expected 1 to 8 cells");
  require(coplanar > 0.0 && std::isfinite(coplanar), "coplanar: expected a positive length");
  for (const double odds : {for_static, for_dynamic})
    require(odds >= 0.0 && std::isfinite(odds), "expected log odds of at least 0");
  require(std::isfinite(least) && std::isfinite(most) && least <= most, "expected least <= most");
  require_probability(moved, "moved");
  require(rounds >= 0, "rounds: expected no negative number");
  return {radius, coplanar, for_static, for_dynamic, least, most, moved, rounds};
}

template <int D>
auto settled(const Surface<D>& surface, const Flat<float>& log_odds, const Spans& spans,
             double radius, double coplanar, double for_static, double for_dynamic, double least,
             double most, double moved, int rounds, int threads) {
  const Span* hit = of_elements(surface, spans);
  const size_t n = surface.size();
  require(log_odds.shape(0) == n, "log_odds: expected one per element");
  for (size_t k = 0; k < n; ++k) require(!std::isnan(log_odds.data()[k]), "log_odds: not a number");
  const BesideOptions options =
      checked(radius, coplanar, for_static, for_dynamic, least, most, moved, rounds);
  std::vector<float> out;
  {
    nb::gil_scoped_release released;
    out = Beside<D>(surface, log_odds.data(), hit, options, threads).settle();
  }
  return owned(std::move(out), {n});
}

template <int D>
void bind(nb::module_& m) {
  m.def("widen_spans", &widen<D>, nb::arg("surface"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("look").noconvert(),
        nb::arg("spans").noconvert(),
        "Widens spans (E, 2) int32, the first and the last look at which beams ended in the cell "
        "of each element, by these scans; look (T,) int64.");
  m.def("settled", &settled<D>, nb::arg("surface"), nb::arg("log_odds").noconvert(),
        nb::arg("spans").noconvert(), nb::kw_only(), nb::arg("radius"), nb::arg("coplanar"),
        nb::arg("for_static"), nb::arg("for_dynamic"), nb::arg("least"), nb::arg("most"),
        nb::arg("moved"), nb::arg("rounds"), nb::arg("threads") = 1,
        "(E,) float32 probability of being static, from log odds (E,) float32 that the looks at "
        "each element alone give and from the elements within a radius (cells) of it.");
}

}  // namespace

void bind_beside(nb::module_& m) { bind<3>(m); }

}  // namespace stillmap::border
