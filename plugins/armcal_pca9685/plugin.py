"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_links(register: Register) -> None:
    register("linux_i2c", "armcal_pca9685.links:LinuxI2cLink", "an I2C bus of this computer")
    register("framed", "armcal_pca9685.links:FramedLink", "a board that looks after the arm by itself")


@hookimpl
def armcal_register_devices(register: Register) -> None:
    register("pca9685", "armcal_pca9685.device:Pca9685Device", "servos on PCA9685 boards")
