# For building biped_mfpt_msgs against ROS 2 installed from Python wheels; an ordinary ROS 2 needs none of this.
# Passed as CMAKE_PROJECT_INCLUDE: the imported targets of the wheels name Python's include folders on the machine
# that built the wheels, and CMake refuses folders that do not exist. Put this machine's in their place.
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
