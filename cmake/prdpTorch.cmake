# LibTorch as the target prdp::torch: its headers and the libraries that the CPU needs, as torch's own extensions for
# setuptools link them. find_package(Torch) asks for the CUDA toolkit where torch was built with CUDA; nothing here does.
# Sets prdp_torch_release, such as 2.13, and TORCH_INSTALL_PREFIX; or prdp_torch_problem, a sentence.
find_path(Torch_DIR TorchConfig.cmake HINTS ${CMAKE_PREFIX_PATH} $ENV{CMAKE_PREFIX_PATH}
  PATH_SUFFIXES Torch share/cmake/Torch)

# A function, as the file of torch sets variables of whoever is looking for a package.
function(prdp_torch_version version)
  include(${Torch_DIR}/TorchConfigVersion.cmake)
  set(${version} ${PACKAGE_VERSION} PARENT_SCOPE)
endfunction()

unset(prdp_torch_problem)
if(Torch_DIR AND NOT EXISTS ${Torch_DIR}/TorchConfigVersion.cmake)
  set(prdp_torch_problem "Torch_DIR is ${Torch_DIR}, where there is no LibTorch; leave it out, or give the folder of TorchConfig.cmake")
  return()
endif()
if(NOT Torch_DIR)
  set(prdp_torch_problem "LibTorch was not found; give the folder that torch.utils.cmake_prefix_path names in CMAKE_PREFIX_PATH")
  return()
endif()
prdp_torch_version(prdp_torch_version)
if(prdp_torch_version VERSION_LESS 2.11)
  set(prdp_torch_problem "needs PyTorch 2.11 or newer, found ${prdp_torch_version} in ${Torch_DIR}; pip install torch==2.13.0")
  return()
endif()
string(REGEX MATCH "^[0-9]+\\.[0-9]+" prdp_torch_release ${prdp_torch_version})
get_filename_component(TORCH_INSTALL_PREFIX ${Torch_DIR}/../../.. ABSOLUTE)
if(NOT TARGET prdp::torch)
  add_library(prdp::torch INTERFACE IMPORTED)
  target_include_directories(prdp::torch INTERFACE
    ${TORCH_INSTALL_PREFIX}/include ${TORCH_INSTALL_PREFIX}/include/torch/csrc/api/include)
  # libtorch registers the kernels of all devices, so it is loaded although no symbol of it is used.
  set(torch_libraries ${TORCH_INSTALL_PREFIX}/lib/${CMAKE_SHARED_LIBRARY_PREFIX})
  target_link_libraries(prdp::torch INTERFACE
    -Wl,--no-as-needed ${torch_libraries}torch${CMAKE_SHARED_LIBRARY_SUFFIX} -Wl,--as-needed
    ${torch_libraries}torch_cpu${CMAKE_SHARED_LIBRARY_SUFFIX} ${torch_libraries}c10${CMAKE_SHARED_LIBRARY_SUFFIX})
endif()
