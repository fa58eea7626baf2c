#pragma once
/// Everything the library offers to C++.
#include "prdp/autograd/detach_failed.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/controller/attach.h"
#include "prdp/controller/linear_schedule.h"
#include "prdp/controller/prdp_controller.h"
#include "prdp/controller/tolerance_controller.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/steppers/flow/flow.h"
#include "prdp/steppers/implicit_step.h"
#include "prdp/steppers/steppers.h"
