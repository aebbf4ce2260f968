# For building biped_mfpt_msgs against ROS 2 from Python wheels, given to CMake as CMAKE_PROJECT_INCLUDE.
# An ordinary ROS 2 needs none of this.

# The imported targets of the wheels name Python's include folders on the machine that built the wheels, and CMake
# refuses folders that do not exist. Put this machine's in their place.
function(_use_python_of_this_machine)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(folders MATCHES "/opt/python/")
      list(FILTER folders EXCLUDE REGEX "^/opt/python/")
      list(APPEND folders ${Python3_INCLUDE_DIRS})
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${folders}")
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL _use_python_of_this_machine)

# Only Python nodes run in the virtual environment: without the C++ generators the messages build in half the time.
find_package(ament_cmake_core REQUIRED)
macro(ament_register_extension extension_point package_name file_name)
  if(NOT "${package_name}" MATCHES "_cpp$")
    list(APPEND AMENT_EXTENSIONS_${extension_point} "${package_name}:${file_name}")
  endif()
endmacro()
