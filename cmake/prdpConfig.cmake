include("${CMAKE_CURRENT_LIST_DIR}/prdpTorch.cmake")
include("${CMAKE_CURRENT_LIST_DIR}/prdpTargets.cmake")
