# ROS 2 Jazzy with slpi_ros: docker build -t slpi_ros . && docker run --rm -it --network host slpi_ros
FROM ros:jazzy-ros-base

SHELL ["/bin/bash", "-o", "pipefail", "-c"]

# Without versions: Ubuntu removes old ones from its archive.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        python3-jinja2 \
        python3-jsonschema \
        python3-matplotlib \
        python3-numba \
        python3-numpy \
        python3-pandas \
        python3-pip \
        python3-ruamel.yaml \
        python3-scipy \
        python3-threadpoolctl \
        ros-jazzy-rosbag2-storage-mcap \
    && rm -rf /var/lib/apt/lists/*

# Not in Ubuntu; the container is the environment.
RUN pip install --no-cache-dir --break-system-packages osqp==1.1.3 rosbags==0.11.9

COPY . /workspace/src/slpi_ros
WORKDIR /workspace
RUN source /opt/ros/jazzy/setup.bash \
    && colcon build --packages-select slpi_ros \
    && sed -i 's|^exec|source /workspace/install/setup.bash\nexec|' /ros_entrypoint.sh

# For the command slpi.
ENV PATH="${PATH}:/workspace/install/slpi_ros/lib/slpi_ros"
WORKDIR /data
CMD ["ros2", "pkg", "executables", "slpi_ros"]
