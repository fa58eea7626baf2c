// Compiled once per instruction set, with PRDP_LEVEL naming it. Everything but the two tables has
// internal linkage, nothing of the standard library is instantiated, and Eigen has a name of its own: no
// code for one processor can be linked in the place of another's.
#define PRDP_JOIN_(a, b) a##b
#define PRDP_JOIN(a, b) PRDP_JOIN_(a, b)
#define Eigen PRDP_JOIN(Eigen_, PRDP_LEVEL)

#include "prdp/kernels/dense_loops.h"
#include "prdp/kernels/factor_lu.h"
#include "prdp/kernels/flow_loops.h"
#include "prdp/kernels/laplacian_loops.h"
#include "prdp/kernels/multigrid_loops.h"
#include "prdp/kernels/stencil_loops.h"
#include "prdp/kernels/vector_loops.h"

namespace prdp::kernels {

namespace {

template <class T>
constexpr Loops<T> table(const char* level) {
  return {.level = level,
          .largest_magnitude = largest_magnitude<T>,
          .copy_rows = copy_rows<T>,
          .dot = dot<T>,
          .scale = scale<T>,
          .scale_with_dots = scale_with_dots<T>,
          .axpy = axpy<T>,
          .add_product = add_product<T>,
          .xpby = xpby<T>,
          .xpby_with_square = xpby_with_square<T>,
          .update_iterate_and_residual = update_iterate_and_residual<T>,
          .weigh = weigh<T>,
          .multi_dot = multi_dot<T>,
          .multi_axpy = multi_axpy<T>,
          .apply = {apply<1, T>, apply<2, T>, apply<3, T>},
          .sweeps = {sweeps<1, T>, sweeps<2, T>, sweeps<3, T>},
          .sweep_and_measure = {sweep_and_measure<1, T>, sweep_and_measure<2, T>, sweep_and_measure<3, T>},
          .upwind_row = upwind_row<T>,
          .apply_neighbours = {apply_neighbours<1, T>, apply_neighbours<2, T>, apply_neighbours<3, T>},
          .apply_offsets = apply_offsets<T>,
          .sweep_neighbours = {sweep_neighbours<1, T>, sweep_neighbours<2, T>, sweep_neighbours<3, T>},
          .sweep_offsets = sweep_offsets<T>,
          .apply_staggered = apply_staggered<T>,
          .smooth_neighbours = {smooth_neighbours<1, T>, smooth_neighbours<2, T>, smooth_neighbours<3, T>},
          .smooth_offsets = smooth_offsets<T>,
          .smooth = {smooth<1, T>, smooth<2, T>, smooth<3, T>},
          .residual_neighbours = {residual_neighbours<1, T>, residual_neighbours<2, T>, residual_neighbours<3, T>},
          .residual_offsets = residual_offsets<T>,
          .residual = {residual<1, T>, residual<2, T>, residual<3, T>},
          .restrict_row = restrict_row<T>,
          .add_interpolated = add_interpolated<T>,
          .split = split<T>,
          .add_merged = add_merged<T>,
          .galerkin_product = galerkin_product<T>,
          .multiply = multiply<T>,
          .add_rows = add_rows<T>,
          .factor_lu = factor_lu,
          .solve_lu = {solve_lu<1>, solve_lu<2>, solve_lu<4>, solve_lu<8>},
          .advect_row = advect_row<T>,
          .advect_row_back = advect_row_back<T>};
}

}  // namespace

extern const Loops<float> PRDP_JOIN(float_loops_, PRDP_LEVEL);
extern const Loops<double> PRDP_JOIN(double_loops_, PRDP_LEVEL);
const Loops<float> PRDP_JOIN(float_loops_, PRDP_LEVEL) = table<float>(PRDP_LEVEL_NAME);
const Loops<double> PRDP_JOIN(double_loops_, PRDP_LEVEL) = table<double>(PRDP_LEVEL_NAME);

}  // namespace prdp::kernels
